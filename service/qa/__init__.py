"""QA in the service: one run at a time on its own thread, judged by the site's bounds, stored and printed."""
