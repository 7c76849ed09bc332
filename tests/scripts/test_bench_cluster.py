import json

import bench_cluster


def test_a_byte_a_file_and_a_count_that_differ_are_found_and_times_and_commands_are_not(tmp_path):
    def run(name, byte=b"a", more=(), count=3, time="noon"):
        folder = tmp_path / name / "scene" / "clip-01234567"
        folder.mkdir(parents=True)
        (folder / "mesh").write_bytes(bytes(1000) + byte)
        told = {"counts": {"frames": count}, "provenance": {"time": time, "argv": [name]}}
        for file in (*more, "record.json"):
            (folder / file).write_text(json.dumps(told))
        return tmp_path / name

    one = run("one")

    def differing(other):
        return bench_cluster.compared(one, other)["files_that_differ"]

    assert bench_cluster.compared(one, one) == {"results": 1, "files": 2, "files_that_differ": 0}
    assert differing(run("later", time="midnight")) == 0
    assert differing(run("byte", byte=b"b")) == 1
    assert differing(run("more", more=["v2p.json"])) == 1
    assert differing(run("count", count=4)) == 1
    assert differing(tmp_path / "nowhere") == 2
