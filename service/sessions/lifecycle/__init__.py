"""Starting, commanding, recording and ending a session."""
