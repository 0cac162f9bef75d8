"""The kernel's signal to an engine process whose service has ended, in case it does not read its channels.

Linux sends it when the thread ends that started the process: the one that keeps the standby process.
"""

import signal

from engine.core.parent_death import signal_at_parent_death


def end_with_the_service() -> None:
    """Request SIGKILL: no line is open yet, and a camera driver that hangs would keep the camera."""
    signal_at_parent_death(signal.SIGKILL)


def wake_without_the_service() -> None:
    """Request SIGCONT: a stopped process continues, to hold its session's line and complete its journal before it ends.

    The kernel also continues orphaned process groups; whether it does depends on the group's parents.
    """
    signal_at_parent_death(signal.SIGCONT)
