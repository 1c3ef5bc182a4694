"""``python -m acquisition`` is ``linetrack``."""

from acquisition.cli import main

if __name__ == "__main__":
    main()
