"""Limits on connections, below the web framework.

A framework sees only complete requests. This package handles clients that send half a request, do not read their
answer, or open connections without end: connections are counted, bounded, refused with a problem where HTTP allows an
answer, and logged as counts.
"""
