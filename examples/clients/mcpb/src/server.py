"""Entry point of the bundle: the command line of the package."""

from vehanchor.cli.app import main

if __name__ == "__main__":
    main()
