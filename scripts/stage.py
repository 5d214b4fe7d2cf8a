"""Run one stage of a chain: python scripts/stage.py NAME --help"""

import gc

gc.disable()  # what is imported stays; looking through it takes a tenth of the start. The runner enables it again

import _project  # noqa: E402, F401
from nishiki.stages.runner import main  # noqa: E402

if __name__ == "__main__":
    main()
