"""``python -m vehanchor`` is the command ``vehanchor``."""

from vehanchor.cli.app import main

if __name__ == "__main__":
    main()
