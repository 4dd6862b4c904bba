"""What people look at: tables on the terminal, and what a recording holds."""
