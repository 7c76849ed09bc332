"""Errors reach the user from worker processes too."""

import pickle

import pytest

from v2p_data.errors import ItemRejectedError, UnusableError, V2PError


@pytest.mark.parametrize(
    "error",
    [
        V2PError("no such folder"),
        ItemRejectedError("camera_moves", "the camera moves by 40 px", 40.0),
        ItemRejectedError("mesh_missing", "mesh of 'cup' is missing"),
        UnusableError("damaged", "task.json is cut"),
    ],
)
def test_an_error_is_the_same_after_the_way_between_processes(error: V2PError):
    there = pickle.loads(pickle.dumps(error))

    assert type(there) is type(error)
    assert str(there) == str(error)
    assert vars(there) == vars(error)


def test_an_error_that_quotes_a_stranger_holds_no_orders_for_a_terminal():
    error = ItemRejectedError("worker_refused", "it said 'no\x1b[2J\u202e\udce9' of 'क्\u200dष'")

    assert str(error) == error.detail == "it said 'no\\x1b[2J\\u202e\\udce9' of 'क्\u200dष'"
