"""Checkpoints small enough for a test: the real model classes with tiny configurations and random weights, saved."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

WORDS = ["red", "brown", "blue", "box", "cup", "the", "small", "a", "photo", "of"]
KINDS = ("grounding_dino", "mm_grounding_dino", "owlv2", "sam2", "depth_anything", "depth_pro")


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
    for number, token in {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]",
                          1012: ".", 1029: "?"}.items():  # fmt: skip
        words[number] = token
    (folder / "vocab.txt").write_text("\n".join(words))
    return BertTokenizerFast(str(folder / "vocab.txt")), len(words)


def dino_parts(folder: Path) -> tuple[dict, object]:
    from transformers import (
        BertConfig,
        GroundingDinoImageProcessor,
        GroundingDinoProcessor,
        SwinConfig,
    )

    tokenizer, vocab = bert_tokenizer(folder)
    parts = {
        "backbone_config": SwinConfig(
            image_size=64, patch_size=4, embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 1, 1],
            window_size=2, out_features=["stage2", "stage3", "stage4"],
        ),
        "text_config": BertConfig(
            vocab_size=vocab, hidden_size=16, num_hidden_layers=1, num_attention_heads=2,
            intermediate_size=16, max_position_embeddings=256,
        ),
        "num_queries": 12, "d_model": 32, "encoder_layers": 1, "decoder_layers": 2,
        "encoder_ffn_dim": 16, "decoder_ffn_dim": 16, "encoder_attention_heads": 2,
        "decoder_attention_heads": 2, "num_feature_levels": 4,
    }  # fmt: skip
    images = GroundingDinoImageProcessor(size={"shortest_edge": 64, "longest_edge": 96})
    return parts, GroundingDinoProcessor(images, tokenizer)


def make_grounding_dino(folder: Path) -> None:
    from transformers import GroundingDinoConfig, GroundingDinoForObjectDetection

    parts, processor = dino_parts(folder)
    GroundingDinoForObjectDetection(GroundingDinoConfig(**parts)).save_pretrained(folder)
    processor.save_pretrained(folder)


def make_mm_grounding_dino(folder: Path) -> None:
    from transformers import MMGroundingDinoConfig, MMGroundingDinoForObjectDetection

    parts, processor = dino_parts(folder)
    MMGroundingDinoForObjectDetection(MMGroundingDinoConfig(**parts)).save_pretrained(folder)
    processor.save_pretrained(folder)


def make_owlv2(folder: Path) -> None:
    from transformers import (
        CLIPTokenizerFast,
        Owlv2Config,
        Owlv2ForObjectDetection,
        Owlv2ImageProcessor,
        Owlv2Processor,
    )

    letters = sorted({c for word in WORDS for c in word})
    tokens = [*letters, *(c + "</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({t: i for i, t in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = CLIPTokenizerFast(
        str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=16
    )
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1,
             "num_attention_heads": 2}  # fmt: skip
    ends = {"bos_token_id": len(tokens) - 2, "eos_token_id": len(tokens) - 1, "pad_token_id": 0}
    config = Owlv2Config(
        text_config={**small, **ends, "vocab_size": len(tokens), "max_position_embeddings": 16},
        vision_config={**small, "image_size": 32, "patch_size": 8},
        projection_dim=16,
    )
    model = Owlv2ForObjectDetection(config)
    model.box_head.dense2.weight.data *= (
        0.01  # untrained, it would throw every box out of the picture
    )
    model.save_pretrained(folder)
    images = Owlv2ImageProcessor(size={"height": 32, "width": 32})
    Owlv2Processor(images, tokenizer).save_pretrained(folder)


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


def dinov2(**more) -> dict:
    return {"model_type": "dinov2", "hidden_size": 16, "num_hidden_layers": 4,
            "num_attention_heads": 2, "mlp_ratio": 1, **more}  # fmt: skip


def make_depth_anything(folder: Path, kind: str = "metric") -> None:
    from transformers import (
        DepthAnythingConfig,
        DepthAnythingForDepthEstimation,
        Dinov2Config,
        DPTImageProcessor,
    )

    backbone = dinov2(image_size=56, patch_size=14, reshape_hidden_states=False)
    config = DepthAnythingConfig(
        backbone_config=Dinov2Config(
            out_features=["stage1", "stage2", "stage3", "stage4"], **backbone
        ),
        patch_size=14, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8, head_hidden_size=8, depth_estimation_type=kind, max_depth=20,
    )  # fmt: skip
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    DPTImageProcessor(
        size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14
    ).save_pretrained(folder)


def make_depth_pro(folder: Path) -> None:
    from transformers import DepthProConfig, DepthProForDepthEstimation, DepthProImageProcessor

    part = dinov2(image_size=32, patch_size=8)
    config = DepthProConfig(
        patch_size=32, fusion_hidden_size=16, intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[8, 8], scaled_images_feature_dims=[8, 8, 8],
        scaled_images_ratios=[0.25, 0.5, 1.0], merge_padding_value=1, use_fov_model=True, num_fov_head_layers=0,
        image_model_config=part, patch_model_config=part, fov_model_config=part,
    )  # fmt: skip
    DepthProForDepthEstimation(config).save_pretrained(folder)
    DepthProImageProcessor(size={"height": 128, "width": 128}).save_pretrained(folder)


MAKERS = {kind: globals()[f"make_{kind}"] for kind in KINDS}
