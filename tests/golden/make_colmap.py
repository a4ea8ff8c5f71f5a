"""Makes the COLMAP models in tests/golden/colmap with COLMAP's own code.

Run from the project's root: ``python tests/golden/make_colmap.py``; needs ``pycolmap==4.2.1``.
A rig of two cameras was at two places; expected.json has what pycolmap says of each image's
pose, and of where points in front of a camera of each model are seen.
"""

import json
from pathlib import Path

import numpy as np
import pycolmap

FOLDER = Path(__file__).parent / "colmap"
SIZE = (64, 48)
LENSES = {
    "SIMPLE_PINHOLE": [50.0, 31.5, 24.25],
    "PINHOLE": [50.0, 51.0, 31.5, 24.25],
    "SIMPLE_RADIAL": [50.0, 31.5, 24.25, -0.08],
    "RADIAL": [50.0, 31.5, 24.25, -0.08, 0.02],
    "OPENCV": [50.0, 51.0, 31.5, 24.25, -0.08, 0.02, 0.003, -0.002],
    "FULL_OPENCV": [
        *[50.0, 51.0, 31.5, 24.25, -0.08, 0.02, 0.003, -0.002],
        *[0.004, 0.01, -0.005, 0.002],
    ],
    "OPENCV_FISHEYE": [50.0, 51.0, 31.5, 24.25, -0.02, 0.01, -0.003, 0.001],
    "SIMPLE_RADIAL_FISHEYE": [50.0, 31.5, 24.25, -0.02],
    "RADIAL_FISHEYE": [50.0, 31.5, 24.25, -0.02, 0.01],
    "SIMPLE_FISHEYE": [50.0, 31.5, 24.25],
    "FISHEYE": [50.0, 51.0, 31.5, 24.25],
    "FOV": [50.0, 51.0, 31.5, 24.25, 0.3],
    "THIN_PRISM_FISHEYE": [50.0, 51.0, 31.5, 24.25, *([0.001] * 8)],
    "DIVISION": [50.0, 51.0, 31.5, 24.25, -0.05],
    "EQUIRECTANGULAR": [64.0, 48.0],
}


def rigid(axis: list[float], angle: float, translation: list[float]) -> pycolmap.Rigid3d:
    direction = np.array(axis) / np.linalg.norm(axis)
    quaternion = np.array([*(np.sin(angle / 2) * direction), np.cos(angle / 2)])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion), np.array(translation))


def main() -> None:
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=3)
    for id, name in ((1, "SIMPLE_RADIAL"), (2, "OPENCV_FISHEYE")):
        model.add_camera(
            pycolmap.Camera(
                camera_id=id, model=name, width=SIZE[0], height=SIZE[1], params=LENSES[name]
            )
        )
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    right_from_rig = rigid([0, 1, 0.1], 0.2, [-0.5, 0.01, 0.02])
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), right_from_rig)
    model.add_rig(rig)
    poses = (rigid([1, 2, 3], 0.4, [0.1, 0.2, 0.3]), rigid([3, -1, 2], 1.1, [-0.4, 0.5, 2]))
    image_id = 10
    for number, rig_from_world in enumerate(poses, start=1):
        frame = pycolmap.Frame(frame_id=number, rig_id=3, rig_from_world=rig_from_world)
        images = []
        for camera_id, side in ((1, "left"), (2, "right")):
            image_id += 1
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
            frame.add_data_id(pycolmap.data_t(sensor, image_id))
            images.append(
                pycolmap.Image(
                    name=f"{side}/{number:03d}.png",
                    camera_id=camera_id,
                    image_id=image_id,
                    frame_id=number,
                    points2D=pycolmap.Point2DList(
                        [pycolmap.Point2D(np.array([1.5, 2.5]))] * number
                    ),
                )
            )
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(number)
    for i in range(4):
        track = pycolmap.Track()
        model.add_point3D(
            np.array([i, 0.5, -0.25 * i]), track, np.array([10 * i, 255, i], np.uint8)
        )
    for suffix in ("bin", "txt"):
        (FOLDER / suffix).mkdir(parents=True, exist_ok=True)
    model.write_binary(str(FOLDER / "bin"))
    model.write_text(str(FOLDER / "txt"))
    rays = [[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-0.5, 0.4, 2.0]]
    seen = {}
    for name, parameters in LENSES.items():
        camera = pycolmap.Camera(
            camera_id=1, model=name, width=SIZE[0], height=SIZE[1], params=parameters
        )
        pixels = [camera.img_from_cam(np.array(ray)) for ray in rays]
        seen[name] = {"parameters": parameters, "pixels": [p.tolist() for p in pixels]}
    expected = {
        "pycolmap": pycolmap.__version__,
        "cam_from_world": {
            image.name: image.cam_from_world().matrix().tolist() for image in model.images.values()
        },
        "rays": rays,
        "lenses": seen,
    }
    (FOLDER / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
