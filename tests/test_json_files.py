"""What is wrong with a JSON file is one sentence that names the file, the place and what to do."""

import pytest

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none, read_json, read_object

HARMS = {
    "cut off": (b'{"a": [1,', r"line 1, column 10: .*not valid JSON"),
    "empty": (b"", r"line 1, column 1: .*not valid JSON"),
    "other bytes": (b"\xff\xfe\x00", r"not UTF-8 text"),
    "nested": (b"[" * 100_000, r"nested too deeply"),
    "twice": (b'{"a": 1, "a": 2}', r"two entries for 'a'"),
    "long number": (b'{"a": ' + b"9" * 5000 + b"}", r"a number that cannot be read"),
}


@pytest.mark.parametrize("harm", HARMS)
def test_a_bad_file_is_one_sentence_that_ends_in_the_advice(tmp_path, harm):
    path = tmp_path / "some.json"
    path.write_bytes(HARMS[harm][0])

    with pytest.raises(V2PError, match=rf"some\.json.*{HARMS[harm][1]}.*; make it anew$"):
        read_object(path, "make it anew")


def test_a_folder_and_a_missing_file_are_named(tmp_path):
    for path in (tmp_path, tmp_path / "none.json"):
        with pytest.raises(V2PError, match=f"{path.name} cannot be read: "):
            read_json(path)


def test_a_list_is_no_object(tmp_path):
    path = tmp_path / "some.json"
    path.write_text("[1]")

    assert read_json(path) == [1]
    with pytest.raises(V2PError, match=r"some\.json holds no JSON object; make it anew"):
        read_object(path, "make it anew")


def test_a_byte_order_mark_is_no_harm(tmp_path):
    path = tmp_path / "some.json"
    path.write_bytes(b'\xef\xbb\xbf{"a": 1}')

    assert read_object(path, "") == {"a": 1}


@pytest.mark.parametrize("harm", sorted(HARMS.keys() - {"twice"}))
def test_a_lenient_reader_takes_a_bad_file_for_none(tmp_path, harm):
    path = tmp_path / "some.json"
    path.write_bytes(HARMS[harm][0])

    assert json_or_none(path) is None
    assert json_or_none(tmp_path) is None
    assert json_or_none(tmp_path / "none.json") is None


def test_a_lenient_reader_leaves_files_over_its_limit_alone(tmp_path):
    path = tmp_path / "some.json"
    path.write_text("[1, 2]")

    assert json_or_none(path, max_bytes=5) is None
    assert json_or_none(path, max_bytes=6) == json_or_none(path, max_bytes=None) == [1, 2]
