"""How many examples a law with a dear body gets."""

import os


def examples(usual: int, otherwise: int) -> int:
    """Return ``usual`` in the default suite, ``otherwise`` in the longer Hypothesis profiles."""
    return usual if os.environ.get("HYPOTHESIS_PROFILE", "ci") == "ci" else otherwise
