"""YAML that users write: plain values, and no file that takes memory or time without end."""

from itertools import pairwise

import pytest

from augkitti.errors import InputError
from augkitti.yaml_text import read_yaml

NAMES = "abcdefghij"
LAUGHS = 'a: &a ["x", "x"]\n' + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise(NAMES))
MERGES = "a: &a {x: 1}\n" + "".join(f"{b}: &{b} {{<<: [{', '.join([f'*{a}'] * 9)}]}}\n" for a, b in pairwise(NAMES))


def test_plain_values_come_through(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("cars: [1, 3]\nglass: pass\nground: {cell_m: 0.5}\n")
    assert read_yaml(path, "mend it") == {"cars": [1, 3], "glass": "pass", "ground": {"cell_m": 0.5}}
    path.write_text("")
    assert read_yaml(path, "mend it") is None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (LAUGHS, "aliases"),
        (MERGES, "aliases"),
        ("&a a: *a\n", "aliases"),
        ("[" * 5000, "YAML"),
        ("a: " + "9" * 5000, "YAML"),
        ("a: 2001-13-45\n", "YAML"),
        ("a: !!python/name:os.system\n", "constructor"),
        ("a: !!python/object/apply:os.system [ls]\n", "constructor"),
        ("{[1]: 2}\n", "unhashable"),
        ("a: 1\n" * 20_000, "64 KiB"),
        ("a: \x00", "YAML"),
    ],
)
def test_bombs_objects_and_impossible_values_are_refused_in_one_line(tmp_path, text, problem):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=problem) as caught:
        read_yaml(path, "mend it")
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 600


def test_a_missing_or_binary_file_is_refused(tmp_path):
    with pytest.raises(InputError):
        read_yaml(tmp_path / "none.yaml", "mend it")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError):
        read_yaml(tmp_path / "b.yaml", "mend it")
