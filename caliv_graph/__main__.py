"""Where `caliv-graph` and `python -m caliv_graph` begin.

Nothing is imported here that takes time: an interrupt shall find a handler from the first moment.
"""

import os
import signal


def _leave(*_: object) -> None:
    """Ends the program before it has begun, or when it has nothing left to do."""
    os.write(2, b"error: interrupted\n")
    os._exit(130)


def main() -> None:
    """Entry point of `caliv-graph`."""
    # Before numpy is: matrices are small, and threads of its library wait for each other, and for
    # those of `common.cores`, at the full cost of a core. Whoever sets the variable decides.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # While modules are imported, Python would answer with a traceback.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    from caliv_graph.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
