"""``python -m limbfit``."""

from .cli import main

if __name__ == "__main__":
    main()
