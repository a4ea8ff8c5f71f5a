"""The order in which layouts are looked for: where a folder has two, the first is read."""

from splatseg.io import captures, scans


def test_order_of_layouts() -> None:
    assert captures.FORMATS == (
        "nerfstudio", "blender", "colmap", "llff", "idr", "replica", "scannet", "scannetpp",
        "kitti360", "waymo",
    )  # fmt: skip
    assert scans.FORMATS == (
        "lidar-npz", "kitti360", "kitti360-sick", "kitti360-points", "semantic-kitti",
        "kitti-odometry", "kitti-raw", "waymo", "las", "ply", "npz",
    )  # fmt: skip


def test_every_layout_of_a_folder_is_found_in_that_order(tmp_path) -> None:
    for name in ("transforms_train.json", "poses_bounds.npy", "transforms.json", "cameras.npz"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "sparse").mkdir()
    for name in ("cameras.txt", "images.txt"):
        (tmp_path / "sparse" / name).write_bytes(b"")
    found = captures.find_formats(tmp_path)
    assert found == ("nerfstudio", "blender", "colmap", "llff", "idr")
