"""The number of examples of a law that sets one of its own."""

import os


def examples(usual: int, otherwise: int | None = None) -> int:
    """Return a third of ``usual`` in the default suite, and ``usual`` in `make test-rare`.

    In the longer Hypothesis profiles it is ``otherwise``, where there is one.
    """
    profile = os.environ.get("HYPOTHESIS_PROFILE", "ci")
    if profile == "ci":
        return usual // 3
    return usual if otherwise is None or profile == "rare" else otherwise
