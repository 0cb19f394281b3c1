"""What the options about maps ask for."""

from pathlib import Path

import pytest

from slam.app.errors import UsageError
from slam.app.run.maps import map_use
from slam.config import load_preset
from slam.library.saved_map import MapFile, save_map
from slam.results import SavedMap

NOTHING = MapFile(
    map=SavedMap(
        radars=(),
        landmarks=(),
        walls=(),
        unknowns=(),
        covariance=(),
        start=(0.0, 0.0, 0.0),
        next_id=0,
    )
)


@pytest.mark.parametrize("start", [(1e300, 0.0, 0.0), (0.0, 0.0, 1e9)])
def test_a_start_beyond_the_earth_is_refused(
    start: tuple[float, float, float], tmp_path: Path
) -> None:
    path = tmp_path / "map.json"
    save_map(path, NOTHING)
    with pytest.raises(UsageError):
        map_use(load_preset("robust"), {"map_path": path, "start": start})
    assert map_use(load_preset("robust"), {"map_path": path}).file == NOTHING
