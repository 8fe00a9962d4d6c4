"""`manicm-ms cloud` as a user of a real camera meets it."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
import yaml

from manicm_ms.cli import USER_ERROR, main
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import CameraError
from manicm_ms.paths import asset
from manicm_ms.sensing.camera_files import default_camera, read_camera, write_camera
from manicm_ms.sensing.depth_cloud import depth_to_cloud
from manicm_ms.sensing.depth_images import write_depth
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.sensing.realism import REALISM, RealismRows, believed_poses, true_cameras
from manicm_ms.spec import DEPTH, POINT_CLOUD

# Of ur3e/slide-block under d435i: the crop floor of 12 mm; and under clean.
WORKSPACE, IDEAL_WORKSPACE = (Box((0.15, -0.25, floor), (0.50, 0.25, 0.15)) for floor in (0.012, 0.003))


@pytest.fixture
def recording(tmp_path):
    """A depth image of bumps on the table, with holes, and its camera's file."""
    camera = default_camera()
    v, u = np.indices((camera.height, camera.width))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    height = 0.02 + 0.02 * np.sin(u / 20) * np.cos(v / 30)
    depth = (height - camera.pose[2, 3]) / (rays @ camera.pose[2, :3])
    depth[np.random.default_rng(0).random(depth.shape) < 0.05] = 0
    write_depth(tmp_path / "depth.png", torch.from_numpy(depth), camera)
    write_camera(tmp_path / "camera.yaml", camera)
    return tmp_path


@pytest.fixture
def objects(recording):
    """The same recording with readings of the workspace alone."""
    camera = default_camera()
    raw = cv2.imread(str(recording / "depth.png"), cv2.IMREAD_UNCHANGED)
    v, u = np.indices(raw.shape)
    z = raw * 0.001
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    points = points @ camera.pose[:3, :3].T + camera.pose[:3, 3]
    seen = ((points > WORKSPACE.low) & (points < WORKSPACE.high)).all(axis=-1)
    assert cv2.imwrite(str(recording / "depth.png"), np.where(seen, raw, 0).astype(np.uint16))
    return recording


@pytest.fixture
def told(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["cloud", *map(str, arguments)])
        return end.value.code, *capsys.readouterr()

    return run


def expected(folder, num_points=512, workspace=WORKSPACE):
    camera = read_camera(folder / "camera.yaml")
    raw = cv2.imread(str(folder / "depth.png"), cv2.IMREAD_UNCHANGED)[89 : 89 + 302, 169 : 169 + 302]
    depth = torch.from_numpy(raw.astype(np.float32) * np.float32(0.001))
    return depth_to_cloud(depth[None], camera, workspace, num_points)[0].numpy()


def test_the_cloud_is_that_of_the_shared_function_to_the_bit(recording, told):
    out = recording / "cloud.npy"
    status, said, _ = told(recording / "depth.png", "--camera", recording / "camera.yaml", "--out", out)
    assert status == 0
    assert "512 points, 512 of them distinct" in said
    np.testing.assert_array_equal(np.load(out, allow_pickle=False), expected(recording))
    status, _, said = told(recording / "depth.png", "--camera", recording / "camera.yaml", "--out", out)
    assert (status, "--overwrite" in said) == (USER_ERROR, True)


def test_realism_chooses_the_crop_floor(recording, told):
    out = recording / "cloud.npy"
    told(recording / "depth.png", "--camera", recording / "camera.yaml", "--out", out, "--realism", "clean")
    points = np.load(out, allow_pickle=False)
    np.testing.assert_array_equal(points, expected(recording, workspace=IDEAL_WORKSPACE))
    assert points[:, 2].min() < 0.012 < expected(recording)[:, 2].min()


def test_ply_holds_the_same_points(recording, told):
    out = recording / "cloud.ply"
    options = ("--camera", recording / "camera.yaml", "--num-points", 100, "--env", "ur3e/slide-block")
    assert told(recording / "depth.png", "--out", out, *options)[0] == 0
    points = np.asarray(trimesh.load(out).vertices, np.float32)
    np.testing.assert_array_equal(points, expected(recording, 100))


def refused(folder, told, changed=None, *options, **fields):
    """The camera file with another pose or other fields gives no cloud; return the one line that says why."""
    content = yaml.safe_load(asset("cameras", "d435i.yaml").read_text()) | fields
    if changed is not None:
        content["T_base_camera"] = changed.tolist()
    (folder / "camera.yaml").write_text(yaml.safe_dump(content))
    out = folder / "cloud.npy"
    status, _, said = told(folder / "depth.png", "--camera", folder / "camera.yaml", "--out", out, *options)
    assert status == USER_ERROR
    assert not out.exists()
    line = said.splitlines()[-1]  # behind the camera file's own warnings
    assert "shows nothing of the workspace of ur3e/slide-block" in line
    return line


def test_a_camera_that_looks_elsewhere_gives_no_cloud(recording, told):
    pose = default_camera().pose
    pose[0, 3] += 3.0
    line = refused(recording, told, pose)
    assert "the workspace is x 0.15 to 0.50, y -0.25 to 0.25, z 0.01 to 0.15 m" in line
    assert re.search(r"it reads x 2\.\d\d to 3\.\d\d, y ", line)
    assert "is T_base_camera that of this cell" in line


def test_an_empty_table_is_no_workspace_and_no_wrong_pose(recording, told):
    camera = default_camera()
    v, u = np.indices((camera.height, camera.width))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    depth = (0.004 - camera.pose[2, 3]) / (rays @ camera.pose[2, :3])
    write_depth(recording / "depth.png", torch.from_numpy(depth), camera)
    assert "the table is seen, and nothing above 12 mm" in refused(recording, told)


def test_readings_that_no_camera_makes_are_said(recording, told):
    raw = cv2.imread(str(recording / "depth.png"), cv2.IMREAD_UNCHANGED)
    raw[raw == 0] = 65535
    assert cv2.imwrite(str(recording / "depth.png"), raw)
    out = recording / "cloud.npy"
    status, said, _ = told(recording / "depth.png", "--camera", recording / "camera.yaml", "--out", out)
    assert status == 0
    assert re.search(r"5 % of the readings are beyond 20 m: does the camera write 65535 for no reading\?", said)


BODY = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float).T  # OpenCV's axes -> x forward, y left, z up


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        (np.linalg.inv, "its inverse"),
        (lambda T: np.diag([-1.0, -1, 1, 1]) @ T, "UR's own base frame"),
        (lambda T: np.block([[T[:3, :3] @ BODY, T[:3, 3:]], [T[3:]]]), "x forward"),
        (lambda T: T @ np.diag([1.0, -1, -1, 1]), "y up"),
        (lambda T: np.block([[T[:3, :3], 1000 * T[:3, 3:]], [T[3:]]]), "millimetres"),
        (lambda T: np.block([[T[:3, :3], 100 * T[:3, 3:]], [T[3:]]]), "centimetres"),
    ],
)
def test_the_usual_mistakes_in_a_pose_are_named(objects, told, wrong, cause):
    pose = wrong(default_camera().pose)
    pose[3] = (0, 0, 0, 1)
    assert cause in refused(objects, told, pose)


def test_another_depth_unit_is_named(objects, told):
    assert "depth_unit looks like 0.001 m, not 0.0005" in refused(objects, told, depth_unit=0.0005)


def test_a_glimpse_of_the_workspace_is_written_and_explained(objects, told):
    pose = default_camera().pose
    pose[0, 3] += 0.345
    camera = replace(default_camera(), T_base_camera=tuple(map(tuple, pose.tolist())))
    write_camera(objects / "camera.yaml", camera)
    out = objects / "cloud.npy"
    status, said, _ = told(objects / "depth.png", "--camera", objects / "camera.yaml", "--out", out)
    assert status == 0
    distinct = len(np.unique(np.load(out), axis=0))
    assert 0 < distinct < 64
    assert f"only {distinct} points are seen: it reads x" in said


def test_intrinsics_of_another_resolution_are_doubted_in_one_line(objects, told):
    camera = replace(default_camera(), fx=424.0, fy=424.0, cx=423.5)
    write_camera(objects / "camera.yaml", camera)
    out = objects / "cloud.npy"
    status, _, said = told(objects / "depth.png", "--camera", objects / "camera.yaml", "--out", out)
    assert status == 0
    assert said.startswith("manicm-ms: warning: ")
    assert said.count("\n") == 1
    assert "cx 423.5 lies far from 319.5, the middle of the 640x480 picture" in said
    assert "those of the 848x480 stream?" in said


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth": "gone.png"}, "gone.png does not exist"),
        ({"--camera": "gone.yaml"}, "gone.yaml does not exist"),
        ({"--env": "ur3e/slide-blok"}, "did you mean 'ur3e/slide-block'"),
        ({"--realism": "d435"}, "did you mean 'd435i'"),
        ({"--out": "cloud.xyz"}, "ends in .ply or .npy"),
        ({"--num-points": "0"}, "at least 1"),
        ({"--num-points": "99999999"}, "1 to 7056, the pixels of the 84x84 picture"),
        ({"--out": "folder.ply"}, "folder.ply is a folder: name a file"),
        ({"--out": "depth.png/cloud.ply"}, "depth.png is a file, so that depth.png/cloud.ply cannot lie in it"),
        ({"depth": "small.png"}, "small.png is 320x240 pixels"),
        ({"depth": "colour.png"}, "3 channel(s) of uint8"),
        ({"--camera": "other.yaml"}, "field model is 'brown_conrady'"),
    ],
)
def test_errors_are_one_line_and_nothing_is_written(recording, told, monkeypatch, changes, words):
    monkeypatch.chdir(recording)
    Path("folder.ply").mkdir()
    cv2.imwrite("small.png", np.full((240, 320), 600, np.uint16))
    cv2.imwrite("colour.png", np.full((480, 640, 3), 60, np.uint8))
    content = yaml.safe_load(asset("cameras", "d435i.yaml").read_text())
    (recording / "other.yaml").write_text(yaml.safe_dump(content | {"model": "brown_conrady"}))
    before = sorted(recording.iterdir())
    given = {"depth": "depth.png", "--camera": "camera.yaml", "--out": "cloud.npy"} | changes
    depth = given.pop("depth")
    status, _, said = told(depth, *[word for pair in given.items() for word in pair])
    assert status == USER_ERROR
    assert said.startswith("manicm-ms: ")
    assert said.count("\n") == 1
    assert words in said
    assert sorted(recording.iterdir()) == before


# ---- the same cloud as the simulator's

ENV_ID, SEED = "ur3e/slide-block", 11


def observed(key, image_size):
    """What the simulated D435i gives under `key` after ten steps of an episode: (h, w) or (P, 3)."""
    env = make_vec(ENV_ID, 1, backend="cpu", obs=(key,), image_size=image_size, realism="d435i")
    try:
        env.reset(seed=[SEED])
        push = torch.tensor([[0.3, -0.5, -1.0, 0.0, 0.0, 0.2, 0.0]])
        for _ in range(10):
            obs, *_ = env.step(push)
        return obs[key][0]
    finally:
        env.close()


def test_the_simulators_cloud_comes_out_of_its_recorded_depth_to_the_bit(tmp_path, told):
    camera = default_camera()
    left, top, width, height = camera.crop
    recorded = torch.zeros(camera.height, camera.width)
    recorded[top : top + height, left : left + width] = observed(DEPTH, (height, width))
    write_depth(tmp_path / "depth.png", recorded, camera)
    # The driver's calibration is wrong in this episode, and its camera file says so.
    values = RealismRows([ENVS.get(ENV_ID).conditions(REALISM.get("d435i"), SEED)])
    pose = believed_poses(true_cameras(camera, values), values)[0]
    assert 1e-3 < np.abs(pose - camera.pose).max() < 2e-2
    write_camera(tmp_path / "camera.yaml", replace(camera, T_base_camera=tuple(map(tuple, pose.tolist()))))
    out = tmp_path / "cloud.npy"
    assert told(tmp_path / "depth.png", "--camera", tmp_path / "camera.yaml", "--out", out, "--env", ENV_ID)[0] == 0
    cloud = observed(POINT_CLOUD, (84, 84)).numpy()
    assert len(np.unique(cloud, axis=0)) > 200
    np.testing.assert_array_equal(np.load(out), cloud)


def test_a_cell_is_not_simulated_with_a_camera_that_sees_nothing_of_it():
    """Demonstrations with empty clouds, and policies that play them, would both be no success."""
    pose = default_camera().pose
    pose[0, 3] += 3.0
    entry = ENVS.get(ENV_ID)
    config = SimulatorConfig(camera=replace(default_camera(), T_base_camera=tuple(map(tuple, pose.tolist()))))
    with pytest.raises(CameraError, match="sees nothing of the workspace of ur3e/slide-block"):
        entry.build(config.specialise(entry.spec), config)


# ---- the guide


def blocks(language):
    guide = (Path(__file__).resolve().parents[2] / "docs/guides/real_camera.md").read_text()
    return re.findall(rf"```{language}\n(.*?)```", guide, flags=re.DOTALL)


def test_the_guides_camera_file_is_the_shipped_one(tmp_path):
    (tmp_path / "camera.yaml").write_text(blocks("yaml")[0])
    assert read_camera(tmp_path / "camera.yaml") == default_camera()


def test_the_guides_loop_runs(tmp_path, monkeypatch):
    write_camera(tmp_path / "camera.yaml", default_camera())
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(next(block for block in blocks("python") if "depth_to_cloud" in block), names)
    assert names["cloud"].shape == (1, 512, 3)
    assert names["cloud"].any()
