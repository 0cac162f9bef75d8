"""Import of RT Plans and RT Ion Plans, and sessions prepared from them.

See docs/4-integrate/plans.md.
"""
