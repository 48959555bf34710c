"""Files are written whole or not at all, and headers are read or refused."""

from __future__ import annotations

import json
import os
import stat

import numpy as np
import pytest
from safetensors.numpy import save

import fracsim
from fracsim.common.files import compact, header_of, write_beside


def test_a_file_is_replaced_whole_and_nothing_is_left_beside_it(tmp_path):
    path = tmp_path / "file"
    for data in (b"before", b"after"):
        write_beside(path, data)
        assert path.read_bytes() == data
    assert os.listdir(tmp_path) == ["file"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_a_write_that_fails_leaves_the_old_file_and_names_the_fault(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_beside(path, b"before")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(fracsim.ModelError, match=r"file: cannot be written \(No space left on device\)"):
        write_beside(path, b"after", fracsim.ModelError)
    assert path.read_bytes() == b"before"
    assert os.listdir(tmp_path) == ["file"]


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(fracsim.FracsimError, match="nowhere does not exist"):
        write_beside(tmp_path / "nowhere" / "file", b"")


def test_a_header_is_read_or_refused():
    def file(metadata):
        return save({"x": np.zeros(1)}, metadata=metadata)

    assert header_of(file({"mine": json.dumps({"a": 1})}), "mine") == {"a": 1}
    with pytest.raises(KeyError):
        header_of(file({"other": "{}"}), "mine")
    with pytest.raises(KeyError):
        header_of(file(None), "mine")
    for wrong in ("[1]", "no JSON", "3"):
        with pytest.raises(ValueError):  # noqa: PT011, as json's own messages are no matter
            header_of(file({"mine": wrong}), "mine")


@pytest.mark.parametrize(
    ("largest", "dtype"), [(0, np.int16), (32767, np.int16), (32768, np.int32), (2**31, np.int64), (-40000, np.int32)]
)
def test_integers_take_no_more_bits_than_they_need(largest, dtype):
    values = compact(np.array([0, largest]))
    assert values.dtype == dtype
    assert values.tolist() == [0, largest]


def test_other_arrays_are_kept_as_they_are():
    values = compact(np.arange(6.0, dtype=np.float32).reshape(2, 3).T)
    assert values.dtype == np.float32
    assert values.flags.c_contiguous
