"""Presets and overrides: Table I comes out, mistakes come out as one clear line."""

import pytest

from slam.config import (
    REMOVED_KEYS,
    Assignment,
    ConfigError,
    EndOfRun,
    SlamConfig,
    config_from_tables,
    load_preset,
    override,
)


def test_preset_paper_is_table_one() -> None:
    config = load_preset("paper", "lab")
    assert config.detection.smoothing_length_bins == 15
    assert config.detection.smoothing_order == 5
    assert config.detection.min_peak_height == 5.5e-3
    assert config.detection.min_peak_prominence == 3e-3
    assert config.detection.max_range_m == 1.5
    assert config.trilateration.field_of_view_deg == 65.0
    assert (config.window.min_distance_m, config.window.min_turn_rad) == (5e-3, 0.1)
    assert config.window.size == 15
    assert config.clustering.min_observations == 9
    assert config.clustering.search_radius_m == 0.2
    assert config.motion.sigma_heading_rad == 0.02
    assert (config.observation.sigma_range_m, config.observation.sigma_bearing_rad) == (0.15, 1.0)


@pytest.mark.parametrize(
    ("environment", "alpha", "sigma_xy_m"), [("lab", 0.6, 1e-4), ("classroom", 1.6, 1e-3)]
)
def test_environments_differ_where_the_paper_says(
    environment: str, alpha: float, sigma_xy_m: float
) -> None:
    config = load_preset("paper", environment)
    assert config.association.gate_threshold == alpha
    assert config.motion.sigma_xy_m == sigma_xy_m
    base = load_preset("paper")
    assert config.clustering == base.clustering
    assert config.motion.sigma_heading_rad == base.motion.sigma_heading_rad


def test_defaults_are_the_preset_paper() -> None:
    assert SlamConfig() == load_preset("paper")


@pytest.mark.parametrize(("preset", "environment"), [("papier", "lab"), ("paper", "moon")])
def test_unknown_names_are_refused(preset: str, environment: str) -> None:
    with pytest.raises(ConfigError):
        load_preset(preset, environment)


@pytest.mark.parametrize(
    "tables",
    [
        {"window": {"sise": 3}},
        {"radar": {}},
        {"window": {"size": 0}},
        {"window": 3},
        {"association": {"gate_rule": "x"}},
        {"detection": {"smoothing_length_bins": 14}},
        {"detection": {"smoothing_order": 15}},
        {"detection": {"min_range_m": 2.0}},
        {"association": {"gate": True}},
        {"window": {"size": False}},
        {"association": {"gate": "0.6"}},
        {"window": {"size": "15"}},
        {"association": {"gate_rule": "chi_square", "gate": 1.5}},
    ],
)
def test_mistake_in_a_file_is_one_line_naming_file_and_key(tables: dict[str, object]) -> None:
    with pytest.raises(ConfigError) as caught:
        config_from_tables(tables, source="x.toml")
    message = str(caught.value)
    assert message.startswith("x.toml: ")
    assert "\n" not in message
    ((part, value),) = tables.items()
    assert (next(iter(value), part) if isinstance(value, dict) else part) in message


def test_environment_of_a_file_must_be_tables() -> None:
    hall = {"environment": {"hall": {"window": 3}}}
    with pytest.raises(ConfigError, match=r"x: environment\.hall\.window: "):
        config_from_tables(hall, environment="hall", source="x")
    with pytest.raises(ConfigError):
        config_from_tables({"environment": 3}, source="x")


@pytest.mark.parametrize("environment", ["lab", "hall", "yard"])
@pytest.mark.parametrize(
    "yard",
    [
        {"window": {"sise": 3}},
        {"windows": {"size": 3}},
        {"window": {"size": 0}},
        {"association": {"gate": True}},
        {"detection": {"min_range_m": 1.0}},
        3,
    ],
)
def test_mistake_in_any_environment_is_found_whichever_is_loaded(
    environment: str, yard: object
) -> None:
    tables = {
        "detection": {"max_range_m": 0.9},
        "environment": {"hall": {"window": {"size": 3}}, "yard": yard},
    }
    with pytest.raises(ConfigError, match=r"x: environment\.yard: "):
        config_from_tables(tables, environment=environment, source="x")


def test_environments_do_not_leak_into_each_other() -> None:
    tables = {
        "window": {"stride": 2},
        "environment": {"hall": {"window": {"size": 3}}, "yard": {"window": {"stride": 4}}},
    }

    def window(environment: str) -> tuple[int, int]:
        config = config_from_tables(tables, environment=environment, source="x")
        return config.window.size, config.window.stride

    assert [window(name) for name in ("lab", "hall", "yard")] == [(15, 2), (3, 2), (15, 4)]


def test_override_reads_text_as_the_type_of_the_key() -> None:
    config = override(
        SlamConfig(),
        {
            "association.assignment": "one_to_one",
            "window.size": "7",
            "window.end_of_run": EndOfRun.FLUSH,
        },
    )
    assert config.association.assignment is Assignment.ONE_TO_ONE
    assert config.window.size == 7
    assert config.window.end_of_run is EndOfRun.FLUSH


@pytest.mark.parametrize(
    ("key", "value"),
    [("window", 1), ("nothing.gate", 1), ("association.gait", 1), ("association.gate", True)],
)
def test_override_refuses_unknown_keys_and_switches(key: str, value: object) -> None:
    with pytest.raises(ConfigError):
        override(SlamConfig(), {key: value})


@pytest.mark.parametrize("default", [0.0, 0, "0", "0.0"])
def test_removed_key_at_its_old_default_is_still_read(default: object) -> None:
    assert override(SlamConfig(), {"robust.calibrated_offset_sigma_m": default}) == SlamConfig()


def test_every_removed_key_at_its_old_default_is_read_from_a_file() -> None:
    tables: dict[str, dict[str, object]] = {"window": {"size": 7}}
    for key, default in REMOVED_KEYS.items():
        part, field = key.split(".")
        tables.setdefault(part, {})[field] = default
    config = config_from_tables(tables, source="x.toml")
    assert config == config_from_tables({"window": {"size": 7}}, source="x.toml")


def test_table_that_held_only_removed_keys_may_be_empty() -> None:
    assert config_from_tables({"leakage": {}}, source="old.toml") == SlamConfig()


@pytest.mark.parametrize("key", REMOVED_KEYS)
@pytest.mark.parametrize("value", [1e-3, "other", True, False, None])
def test_removed_key_at_another_value_is_one_line_naming_key_and_version(
    key: str, value: object
) -> None:
    part, field = key.split(".")
    with pytest.raises(ConfigError, match=rf"^x.toml: {key}: .*0\.1\.0"):
        config_from_tables({part: {field: value}}, source="x.toml")
    with pytest.raises(ConfigError, match=rf"^setting: {key}: .*0\.1\.0"):
        override(SlamConfig(), {key: value})
