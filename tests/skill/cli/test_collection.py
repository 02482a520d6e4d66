"""Garbage collection during imports."""

from __future__ import annotations

import gc

import pytest

from vehanchor.cli.collection import paused_collection


def test_collection_is_paused_in_the_block_and_leaves_its_objects_out_later() -> None:
    frozen = gc.get_freeze_count()
    try:
        with paused_collection():
            assert not gc.isenabled()
            assert gc.get_freeze_count() == frozen
        assert gc.isenabled()
        assert gc.get_freeze_count() > frozen
    finally:
        gc.unfreeze()


def test_collection_goes_on_after_an_error() -> None:
    with pytest.raises(ImportError), paused_collection():
        raise ImportError
    assert gc.isenabled()
