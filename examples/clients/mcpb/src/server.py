"""The bundle's entry point: the command line that the package brings."""

from vehanchor.cli.app import main

if __name__ == "__main__":
    main()
