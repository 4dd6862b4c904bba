"""Used by every room, of no field: files, YAML and JSON text, cores, progress, exit codes."""
