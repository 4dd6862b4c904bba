"""Results for people: tables on the terminal, HTML pages, and the content of a recording."""
