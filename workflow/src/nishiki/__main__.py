"""`python -m nishiki`: the command line."""

from nishiki.cli import main

if __name__ == "__main__":
    main()
