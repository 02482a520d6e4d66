"""Transports: stdio, HTTP and the local viewer."""
