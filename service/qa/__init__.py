"""QA in the service: one run at a time on its own thread, kept for good, judged by the site's bounds, printed."""
