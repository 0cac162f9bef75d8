"""Where frames come from: one adapter a file, each the only importer of its SDK."""
