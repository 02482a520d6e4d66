"""The bundle's entry point: the command line that the package brings."""

from vehanchor.cli import main

if __name__ == "__main__":
    main()
