"""`python -m tumortrack`, and with it `torchrun -m tumortrack`."""

from tumortrack.cli.main import main

if __name__ == "__main__":
    main()
