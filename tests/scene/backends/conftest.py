"""Checkpoints small enough for a test: the real model classes with tiny configurations and random weights, saved."""

from pathlib import Path

import numpy as np
import pytest
import torch

WORDS = ["red", "brown", "blue", "box", "cup", "the", "small", "a", "photo", "of"]


class Checkpoints:
    """Tiny checkpoints, each made when first asked for, and the device that models made of them run on."""

    def __init__(self, root: pytest.TempPathFactory, device: str) -> None:
        self.device = device
        self._root = root
        self._made: dict[str, Path] = {}

    def __call__(self, backend: str) -> str:
        """Return the folder of a backend's checkpoint."""
        if backend not in self._made:
            self._made[backend] = self._root.mktemp(backend)
            with torch.random.fork_rng():
                torch.random.default_generator.manual_seed(0)
                MAKERS[backend](self._made[backend])
        return str(self._made[backend])


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for models that are set up."""
    monkeypatch.setenv("V2P_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory, device: str) -> Checkpoints:
    return Checkpoints(tmp_path_factory, device)


@pytest.fixture
def picture() -> np.ndarray:
    """A red box at the left and a brown one at the right of a grey table, 48 x 64."""
    image = np.full((48, 64, 3), 180, np.uint8)
    image[20:36, 6:22] = (200, 30, 30)
    image[22:38, 40:58] = (120, 70, 30)
    return image


def bert_tokenizer(folder: Path):
    from transformers import BertTokenizerFast

    # The models know [CLS], [SEP], "." and "?" by their numbers in BERT's own list.
    words = [f"[unused{i}]" for i in range(1030)] + WORDS + ["##" + w for w in WORDS]
    for number, token in {
        0: "[PAD]",
        100: "[UNK]",
        101: "[CLS]",
        102: "[SEP]",
        103: "[MASK]",
        1012: ".",
        1029: "?",
    }.items():
        words[number] = token
    (folder / "vocab.txt").write_text("\n".join(words))
    return BertTokenizerFast(str(folder / "vocab.txt")), len(words)


def make_grounding_dino(folder: Path) -> None:
    from transformers import (
        BertConfig,
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessor,
        GroundingDinoProcessor,
        SwinConfig,
    )

    tokenizer, vocab = bert_tokenizer(folder)
    config = GroundingDinoConfig(
        backbone_config=SwinConfig(
            image_size=64, patch_size=4, embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 1, 1],
            window_size=2, out_features=["stage2", "stage3", "stage4"],
        ),
        text_config=BertConfig(
            vocab_size=vocab, hidden_size=16, num_hidden_layers=1, num_attention_heads=2,
            intermediate_size=16, max_position_embeddings=256,
        ),
        num_queries=12, d_model=32, encoder_layers=1, decoder_layers=2, encoder_ffn_dim=16, decoder_ffn_dim=16,
        encoder_attention_heads=2, decoder_attention_heads=2, num_feature_levels=4,
    )  # fmt: skip
    GroundingDinoForObjectDetection(config).save_pretrained(folder)
    images = GroundingDinoImageProcessor(size={"shortest_edge": 64, "longest_edge": 96})
    GroundingDinoProcessor(images, tokenizer).save_pretrained(folder)


def make_sam2(folder: Path) -> None:
    from transformers import (
        Sam2ImageProcessor,
        Sam2VideoConfig,
        Sam2VideoModel,
        Sam2VideoProcessor,
        Sam2VideoVideoProcessor,
    )

    # The memory's 64 channels are fixed in the library, and pointers must be several times as wide.
    config = Sam2VideoConfig(
        vision_config={
            "backbone_config": {
                "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [64, 64],
                "blocks_per_stage": [1, 1, 1, 1], "embed_dim_per_stage": [8, 16, 32, 64],
                "num_attention_heads_per_stage": [1, 1, 1, 1], "global_attention_blocks": [],
                "window_size_per_stage": [4, 4, 4, 4],
            },
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
            "fpn_hidden_size": 128,
        },
        prompt_encoder_config={"hidden_size": 128, "image_size": 64, "patch_size": 16,
                               "mask_input_channels": 8},
        image_size=64, num_maskmem=3, max_object_pointers_in_encoder=4,
        memory_attention_hidden_size=128, memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=16, memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=128, memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128, memory_fuser_num_layers=1, memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=16,
    )  # fmt: skip
    decoder = config.mask_decoder_config
    decoder.hidden_size, decoder.mlp_dim, decoder.num_attention_heads = 128, 16, 2
    decoder.iou_head_hidden_dim = 16
    Sam2VideoModel(config).save_pretrained(folder)
    size = {"height": 64, "width": 64}
    Sam2VideoProcessor(
        Sam2ImageProcessor(size=size), Sam2VideoVideoProcessor(size=size)
    ).save_pretrained(folder)


def make_depth_anything(folder: Path) -> None:
    from transformers import (
        DepthAnythingConfig,
        DepthAnythingForDepthEstimation,
        Dinov2Config,
        DPTImageProcessor,
    )

    config = DepthAnythingConfig(
        backbone_config=Dinov2Config(
            out_features=["stage1", "stage2", "stage3", "stage4"],
            image_size=56,
            patch_size=14,
            reshape_hidden_states=False,
            hidden_size=16,
            num_hidden_layers=4,
            num_attention_heads=2,
            mlp_ratio=1,
        ),
        patch_size=14,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=8,
        depth_estimation_type="metric",
        max_depth=20,
    )
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    DPTImageProcessor(
        size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14
    ).save_pretrained(folder)


MAKERS = {
    "grounding_dino": make_grounding_dino,
    "sam2": make_sam2,
    "depth_anything": make_depth_anything,
}
