"""A model that outlines objects is made ready for one clip; it runs only where a step asks it."""

from v2p_data.errors import V2PError
from v2p_data.scene.backends.config import OutlineConfig
from v2p_data.scene.backends.mobile_sam_setup import installed_weights
from v2p_data.scene.frames.outliner import Outliner
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip


def outliner_of(clip: Clip, working: WorkingClip, cfg: OutlineConfig) -> Outliner | None:
    """Return the model for the clip's frames; None where none is asked for.

    Args:
        clip: the frames that are shown to the model.
        working: the same clip at working size, in whose pixels the model is asked and answers.
        cfg: settings; `auto` was written out by the preset.

    Raises:
        V2PError: the model was not set up here, or its weights cannot be read.
    """
    if cfg.backend != "mobile_sam":
        return None
    weights = cfg.weights or installed_weights()
    if weights is None:
        raise V2PError(
            "scene.outline.backend is 'mobile_sam', which was not set up here; run 'v2p setup outlines', name its file "
            "with --scene.outline.weights, or leave the option out"
        )
    # transformers takes seconds to import.
    from v2p_data.scene.backends.mobile_sam import mobile_sam

    return Outliner(mobile_sam(weights), clip.frames, working.frame_idx, working.shape)
