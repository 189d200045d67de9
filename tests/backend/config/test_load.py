"""A bad settings file gives one error with file, key and reason."""

import pytest

from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.config.method import ProbeSettings, StackSettings
from touchdown.backend.config.toml_file import MAX_BYTES, parse_settings, read_settings
from touchdown.backend.core.faults import InputError


def _write(tmp_path, text):
    path = tmp_path / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_values_are_taken_and_the_rest_is_default(tmp_path):
    settings = read_settings(
        StackSettings, _write(tmp_path, 'strategy = "pick-and-place"\n[probe]\ndepth_mm = 1.0\n')
    )
    assert settings.strategy == "pick-and-place"
    assert settings.probe.depth_mm == 1.0
    assert settings.probe.ramp_fraction == ProbeSettings().ramp_fraction


def test_an_empty_file_is_the_paper(tmp_path):
    settings = read_settings(StackSettings, _write(tmp_path, ""))
    assert settings == StackSettings()
    assert (settings.probe.depth_mm, settings.probe.duration_s) == (1.5, 2.0)
    assert settings.probe.stiffness_n_mm == (30.0, 30.0, 15.0)
    assert (settings.stability.delta, settings.policy.longest_step_mm) == (0.9, 3.0)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[probe]\ndepth_mm = -1.0\n", "probe.depth_mm"),
        ("[probe]\ndepth_mm = nan\n", "probe.depth_mm"),
        ("[probe]\ndepth_mm = inf\n", "probe.depth_mm"),
        ('[probe]\ndepth_mm = "deep"\n', "probe.depth_mm"),
        ("[probe]\nstiffness_n_mm = [30.0, 30.0]\n", "probe.stiffness_n_mm"),
        ("[stability]\ndelta = 1.0\n", "stability.delta"),
        ("[policy]\nmax_probes = 0\n", "policy.max_probes"),
        ('strategy = "hope"\n', "strategy"),
        ("[probe]\ndepth = 1.0\n", "probe.depth"),
        ("probe = 3\n", "probe"),
    ],
)
def test_the_error_names_file_and_key(tmp_path, text, key):
    path = _write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_settings(StackSettings, path)
    assert caught.value.where == str(path)
    assert f"'{key}" in caught.value.what
    assert caught.value.fix


@pytest.mark.parametrize(
    ("text", "said", "fix"),
    [
        ("[ft]\nrate = 3", "There is no setting 'ft.rate'.", "'ft.rate_hz'"),
        ("[gelsigt.left]", "There is no setting 'gelsigt'.", "'gelsight'"),
        ("[ft]\nzzz = 3", "There is no setting 'ft.zzz'.", "Remove 'ft.zzz'."),
    ],
)
def test_a_setting_that_nobody_knows_is_called_so_with_the_nearest_one(tmp_path, text, said, fix):
    path = tmp_path / "bench.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_settings(HardwareSettings, path)
    assert caught.value.what == said
    assert fix in caught.value.fix


def test_broken_toml_names_the_line(tmp_path):
    path = _write(tmp_path, "[probe]\ndepth_mm = = 1\n")
    with pytest.raises(InputError, match="line 2") as caught:
        read_settings(StackSettings, path)
    assert caught.value.where == str(path)


def test_a_missing_file_a_folder_and_wrong_bytes_are_named(tmp_path):
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00\x01")
    for path in (tmp_path / "missing.toml", tmp_path, binary):
        with pytest.raises(InputError) as caught:
            read_settings(StackSettings, path)
        assert caught.value.where == str(path)


@pytest.mark.promise("D8")
def test_a_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / "huge.toml"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="too large"):
        read_settings(StackSettings, path)


def test_settings_cannot_be_changed_later():
    settings = parse_settings(StackSettings, {}, "test")
    with pytest.raises(ValueError, match="frozen"):
        settings.probe.depth_mm = 9.0
