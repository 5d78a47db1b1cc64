"""`python -m microdrivers`."""

from microdrivers.cli.main import main

if __name__ == "__main__":
    main(prog_name="microdrivers")
