"""What proves the product: phantom, virtual set-ups, evaluation, performance, simulated planning system, demo.

A distribution of its own, ``tidegate-lab``. `tidegate` finds its commands and its virtual set-ups by entry points;
`engine` and `service` import nothing of it.
"""
