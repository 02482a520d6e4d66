"""Many photographs of one flight: their evidence put together, because they share a scale or because they overlap.

photographs -> each one's view -> one body of evidence (same scale), or
photographs -> features -> pairs -> links -> relative scales of islands -> one body of evidence an island -> record
"""
