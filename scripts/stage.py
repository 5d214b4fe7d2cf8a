"""Run one stage of a chain: python scripts/stage.py NAME --help"""

import _project  # noqa: F401
from nishiki.stages.runner import main

if __name__ == "__main__":
    main()
