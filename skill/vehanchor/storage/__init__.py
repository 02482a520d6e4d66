"""Atomic files, and journals of long runs."""
