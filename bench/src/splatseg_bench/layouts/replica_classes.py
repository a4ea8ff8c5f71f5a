"""The classes of Replica by the ids that its maps have: 1 to 101, and 0 for none.

They are those of every scene's ``info_semantic.json``, in its order (Straub et al., The Replica
Dataset, 2019). Which are things is not told there: a protocol says it.
"""

from splatseg.core import ClassInfo, ClassTable

_NAMES = (
    "backpack", "base-cabinet", "basket", "bathtub", "beam", "beanbag", "bed", "bench", "bike",
    "bin", "blanket", "blinds", "book", "bottle", "box", "bowl", "camera", "cabinet", "candle",
    "chair", "chopping-board", "clock", "cloth", "clothing", "coaster", "comforter",
    "computer-keyboard", "cup", "cushion", "curtain", "ceiling", "cooktop", "countertop", "desk",
    "desk-organizer", "desktop-computer", "door", "exercise-ball", "faucet", "floor", "handbag",
    "hair-dryer", "handrail", "indoor-plant", "knife-block", "kitchen-utensil", "lamp", "laptop",
    "major-appliance", "mat", "microwave", "monitor", "mouse", "nightstand", "pan", "panel",
    "paper-towel", "phone", "picture", "pillar", "pillow", "pipe", "plant-stand", "plate", "pot",
    "rack", "refrigerator", "remote-control", "scarf", "sculpture", "shelf", "shoe",
    "shower-stall", "sink", "small-appliance", "sofa", "stair", "stool", "switch", "table",
    "table-runner", "tablet", "tissue-paper", "toilet", "toothbrush", "towel", "tv-screen",
    "tv-stand", "umbrella", "utensil-holder", "vase", "vent", "wall", "wall-cabinet", "wall-plug",
    "wardrobe", "window", "rug", "logo", "bag", "set-of-clothing",
)  # fmt: skip

REPLICA_CLASSES = ClassTable(
    rows=tuple(ClassInfo(id=id, name=name) for id, name in enumerate(_NAMES, start=1))
)
"""All 101 of them."""
