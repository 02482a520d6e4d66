"""Scales of the photographs of one flight: pool evidence by a common scale or by overlaps.

same scale: photographs -> views -> pooled evidence -> record
overlaps:   photographs -> features -> pairs -> links -> components -> pooled evidence of each component -> record
"""
