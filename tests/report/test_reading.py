"""A run is read as it is: newest results, failures, leftovers, and files that are no records."""

import json

from v2p_data.report.reading import dropped, model_use, read_run, span


def test_the_newest_complete_result_counts(run):
    run.record(
        run.folder("scene", "a", "11111111"), time="2026-01-01T00:00:00Z", counts={"kind": "old"}
    )
    run.record(
        run.folder("scene", "a", "00000000"), time="2026-02-01T00:00:00Z", counts={"kind": "new"}
    )

    found = read_run(run.root)

    assert found.items == ["a"]
    assert found.get("scene", "a").counts == {"kind": "new"}


def test_what_the_last_command_kept_counts_though_something_newer_was_tried_between(run):
    """A hint was tried, rejected, and taken out again."""
    kept = run.record(
        run.folder("scene", "a", "11111111"), time="2026-01-01T00:00:00Z", counts={"kind": "kept"}
    )
    run.record(
        run.folder("scene", "a", "00000000"), time="2026-02-01T00:00:00Z", counts={"kind": "tried"}
    )
    outcome = {"stage": "scene", "item": "a", "status": "kept", "folder": kept.name}
    (run.root / "run.json").write_text(json.dumps([outcome]))

    assert read_run(run.root).get("scene", "a").counts == {"kind": "kept"}


def test_a_partial_folder_never_hides_a_complete_one(run):
    run.record(run.folder("scene", "a"))
    (run.root / "scene" / "a-99999999.partial").mkdir()

    assert read_run(run.root).get("scene", "a").status == "made"


def test_leftovers_are_unfinished_and_tracebacks_are_failures(run):
    (run.root / "task" / "a-99999999.partial").mkdir(parents=True)
    crashed = run.root / "task" / "two-words-88888888.partial"
    crashed.mkdir()
    (crashed / "traceback.txt").write_text("Traceback\n  line\nValueError: boom\n")

    found = read_run(run.root)

    assert found.get("task", "a").status == "unfinished"
    assert found.get("task", "two-words").status == "failed"
    assert found.get("task", "two-words").detail == "ValueError: boom"


def test_failures_of_the_last_command_are_known_from_its_outcomes(run):
    run.record(run.folder("scene", "a"))
    (run.root / "run.json").write_text(
        json.dumps(
            [
                {
                    "stage": "scene",
                    "item": "a",
                    "status": "failed",
                    "reason": "stale",
                    "detail": "",
                },
                {
                    "stage": "task",
                    "item": "a",
                    "status": "failed",
                    "reason": "error",
                    "detail": "no such kind",
                },
                {
                    "stage": "expert",
                    "item": "a",
                    "status": "blocked",
                    "reason": "",
                    "detail": "task failed",
                },
                {"stage": "../../etc", "item": "a", "status": "failed"},
                "nonsense",
            ]
        )
    )

    found = read_run(run.root)

    assert found.get("scene", "a").status == "made"
    assert found.get("task", "a").detail == "no such kind"
    assert found.get("expert", "a").status == "not run"
    assert {stage for stage, _ in found.results} == {"scene", "task", "expert"}


def test_a_broken_record_is_named_and_the_others_are_read(run):
    run.record(run.folder("scene", "good"))
    (run.folder("scene", "broken") / "record.json").write_text('{"stage": "sce')
    (run.folder("scene", "foreign") / "record.json").write_text('{"hello": 1}')

    found = read_run(run.root)

    assert found.items == ["good"]
    assert ["broken" in found.unreadable[0], "foreign" in found.unreadable[1]] == [True, True]


def test_dropped_episodes_are_counted_by_reason_with_their_numbers(run):
    run.episodes("lift_mug")
    run.rejected("scene", "shaky", "camera_moves", "it moves", 31.0)

    rows = {(d.item, d.reason): (d.count, d.numbers) for d in dropped(read_run(run.root))}

    assert rows == {
        ("lift_mug", "not_successful"): (2, "0.25 to 0.5"),
        ("shaky", "camera_moves"): (1, "31"),
    }


def test_model_use_is_the_sum_over_all_records(run):
    assert model_use(read_run(run.root)) == {"calls": 0, "tokens": 0}

    run.record(
        run.folder("task", "a"),
        counts={"model_calls": 2, "prompt_tokens": 100, "output_tokens": 20},
    )
    run.record(run.folder("task", "b"), counts={"samples": [{"tokens": 5}, {"tokens": 7}]})

    assert model_use(read_run(run.root)) == {"calls": 2, "tokens": 132}


def test_an_empty_folder_is_an_empty_run(tmp_path):
    assert read_run(tmp_path).results == {}


def test_a_span_leaves_out_what_is_no_number():
    assert span([0.3, None, float("nan"), 0.1, True, "x"]) == "0.1 to 0.3"
    assert span([None]) == ""
