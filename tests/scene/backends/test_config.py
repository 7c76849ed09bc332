import subprocess
import sys

import pytest

from v2p_data.scene.backends.config import DepthConfig, GroundConfig, MeshConfig, SegmentConfig


def test_the_settings_load_without_torch_or_transformers():
    code = (
        "import sys, importlib.util as u; "
        "s = u.find_spec('v2p_data.scene.backends.config'); "
        "m = u.module_from_spec(s); sys.modules[s.name] = m; s.loader.exec_module(m); "
        "print(sorted({'torch', 'transformers', 'numpy'} & set(sys.modules)))"
    )

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: GroundConfig(backend="worker"), "command line"),
        (lambda: GroundConfig(box_threshold=1.5), "box_threshold"),
        (lambda: DepthConfig(device="gpu"), "device"),
        (lambda: DepthConfig(batch_size=0), "batch_size"),
        (lambda: SegmentConfig(num_points=0), "num_points"),
        (lambda: MeshConfig(worker="python 'worker.py"), "cannot be read"),
        (lambda: MeshConfig(worker="w", worker_timeout_s=0.0), "worker_timeout_s"),
    ],
)
def test_a_setting_that_cannot_be_meant_is_refused_by_name(make, said):
    with pytest.raises(ValueError, match=said):
        make()
