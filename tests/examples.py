"""Running the examples in the docstrings of public functions."""

import doctest

import nishiki


def run_examples(name: str) -> None:
    """Run the examples of a public name; AssertionError with what differs."""
    (test,) = doctest.DocTestFinder(recurse=False).find(getattr(nishiki, name), name, globs={})
    assert len(test.examples) > 1
    told = []
    assert not doctest.DocTestRunner(verbose=False).run(test, out=told.append).failed, "".join(told)
