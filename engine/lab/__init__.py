"""What proves the product: phantom, virtual set-ups, evaluation and performance.

Imported by the command line and the tests, by nothing else in the service; a clinical service loads no module of it.
"""
