"""Simulate a capture and its truth: python scripts/simulate.py --help"""

import _project  # noqa: F401, I001

import sys

from nishiki.simulate.command import main

if __name__ == "__main__":
    sys.exit(main())
