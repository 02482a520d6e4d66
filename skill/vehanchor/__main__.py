"""``python -m vehanchor`` is the command ``vehanchor``."""

from vehanchor.cli import main

if __name__ == "__main__":
    main()
