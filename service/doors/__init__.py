"""The way in at the level of the protocol: before there is a request, and after there is one no more.

A web framework sees whole requests. Who sends half of one and waits, who reads nothing of what was asked for, and who
opens connections without end is seen here: counted, bounded, refused with a problem where HTTP still allows an answer,
and told in the log as a number.
"""
