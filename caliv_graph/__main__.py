"""`python -m caliv_graph`, for where scripts are not on the path."""

from caliv_graph.cli.main import main

if __name__ == "__main__":
    main()
