"""`python -m tumortrack`."""

from tumortrack.cli.main import main

if __name__ == "__main__":
    main()
