"""Seconds of automatic masks, by stage, of networks with random weights.

    python benchmarks/mask_generator.py          a tiny SAM, 1024 points on a picture of 640x426
    python benchmarks/mask_generator.py --full   SAM ViT-B at full size

Nothing is filtered before the masks are brought to the picture's size (thresholds 0, every box
kept up to an overlap of 0.98), which is the worst case; with real weights most candidates leave
earlier.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from splatseg.models import LoadOptions, find_model
from splatseg.models._mask_generator import SamOptions, candidates, distinct, grid_points


def tiny(folder: Path, *, full: bool) -> Path:
    """A SAM with random weights."""
    from transformers import SamConfig, SamModel

    torch.manual_seed(7)
    if full:
        config = SamConfig(vision_config={"initializer_range": 0.3})
    else:
        vision: dict[str, Any] = {
            "hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "window_size": 4,
            "global_attn_indexes": [1], "mlp_dim": 64, "initializer_range": 0.3, "image_size": 256,
        }  # fmt: skip
        decoder = {"mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
        config = SamConfig(
            vision_config=vision,
            prompt_encoder_config={"image_size": 256},
            mask_decoder_config=decoder,
            initializer_range=0.3,
        )
    SamModel(config).save_pretrained(folder)
    return folder


def main() -> None:
    """Time the encoder, the prompts, and what follows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="SAM ViT-B instead of a tiny one")
    full = parser.parse_args().full
    options = SamOptions(min_iou=0.0, min_stability=0.0, max_overlap=0.98)
    image = torch.randint(0, 256, (426, 640, 3), dtype=torch.uint8)
    with tempfile.TemporaryDirectory() as name:
        weights = tiny(Path(name) / "sam", full=full)
        model: Any = find_model("sam", options, loading=LoadOptions(weights=str(weights)))
        started = time.perf_counter()
        decode = model._decoder_of(image)
        encoded = time.perf_counter()
        found = candidates(decode, grid_points(options.points_per_side, 426, 640), options)
        prompted = time.perf_counter()
        kept = distinct(found.boxes, found.scores, options.max_overlap)
        masks = model.masks(image)  # the encoder's answer is kept, the prompts are asked again
        done = time.perf_counter()
    asked = prompted - encoded
    print(f"encoder {encoded - started:.2f} s")
    print(f"1024 points {asked:.2f} s: decoder, thresholds, duplicates within a batch")
    print(f"{len(kept)} masks at full size, levels: {done - prompted - asked:.2f} s ({masks})")
    print(f"an image {done - prompted + encoded - started:.2f} s")


if __name__ == "__main__":
    main()
