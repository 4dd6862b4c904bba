"""What every room uses and no field owns: files, YAML text, cores, progress, exit codes."""
