"""Pictures and registered volumes for the page: what is sent, what is skipped, and what is refused."""

import asyncio
import json
import struct
import threading

import aiohttp
import cv2
import numpy as np
import pytest
import torch

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.streaming import pictures as module
from holotorch.experiments.streaming.opening import open_page
from holotorch.experiments.streaming.page import PageServer
from holotorch.experiments.streaming.pictures import Channel, Encoder, PanelSource
from holotorch.experiments.streaming.registered import load_registered, register
from holotorch.io.video import encode_jpeg
from holotorch.scene.volume import Volume
from holotorch.tracking import THESIS, Camera
from holotorch.tracking.pose.overlay import Undistorter, overlay
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now

MATRIX = torch.tensor([[200.0, 0, 79.5], [0, 200, 59.5], [0, 0, 1]], dtype=torch.float64)
CAMERA = Camera(MATRIX, torch.tensor([-0.2, 0.05, 1e-3, 0, 0], dtype=torch.float64), "srgb", (120, 160))
SMOOTH = torch.stack([torch.linspace(10, 240, 160).expand(120, 160)] * 3).to(torch.uint8)


def decoded(jpeg: bytes) -> torch.Tensor:
    bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return torch.from_numpy(bgr[..., ::-1].copy()).permute(2, 0, 1)


def test_pictures_reach_the_pages_as_jpeg_of_the_frame_without_distortion():
    refused = Pose.refused(Status.NO_CATHETER, "none")

    async def run():
        async with (
            PageServer(THESIS, CAMERA, port=0, panel="overlay") as server,
            aiohttp.ClientSession() as session,
            session.ws_connect(server.address + "poses") as socket,
        ):
            assert '"panel": true' in await socket.receive_str()
            server.see(SMOOTH, refused, 12.5)
            found = {}
            while len(found) < 2:
                content = await asyncio.wait_for(socket.receive_bytes(), 10)
                channel, captured, length = struct.unpack("<BdH", content[:11])
                assert captured == 12.5
                if length:
                    assert channel == Channel.CAMERA
                    pose = json.loads(content[11 : 11 + length])
                    assert pose.items() >= {"captured": 12.5, "status": "NO_CATHETER", "reason": "none"}.items()
                found[Channel(channel)] = decoded(content[11 + length :])
            return found

    found = asyncio.run(run())
    plain = found[Channel.CAMERA].float()
    assert (plain - Undistorter(CAMERA)(SMOOTH).float()).abs().mean() < 2
    drawn = overlay(SMOOTH, refused, CAMERA, THESIS).float()
    assert (found[Channel.PANEL].float() - drawn).abs().mean() < 6 < (drawn - SMOOTH.float()).abs().max()


def test_undistorted_frames_are_those_of_the_matrix_alone():
    rows, columns = torch.meshgrid(torch.arange(10.0, 110, 7), torch.arange(10.0, 150, 7), indexing="ij")
    pinhole = torch.stack([columns, rows], -1).reshape(-1, 2).double()
    plane = (pinhole - MATRIX[:2, 2]) / MATRIX.diagonal()[:2]
    places = CAMERA.project(torch.cat([plane, torch.ones(len(plane), 1, dtype=torch.float64)], 1))
    frame = SMOOTH.clone()
    frame[1] = torch.linspace(20, 220, 120)[:, None].expand(120, 160).to(torch.uint8)
    found = Undistorter(CAMERA)(frame)[:, pinhole[:, 1].long(), pinhole[:, 0].long()].double()
    inside = ((places > 1) & (places < torch.tensor([158.0, 118.0]))).all(-1)
    wanted = torch.stack([10 + 230 * places[:, 0] / 159, 20 + 200 * places[:, 1] / 119])
    assert inside.sum() > 200 and (found[:2, inside] - wanted[:, inside]).abs().max() < 2.5


def test_an_encoder_skips_what_it_has_no_time_for(monkeypatch):
    gate, seen = threading.Event(), []
    monkeypatch.setattr(module, "encode_jpeg", lambda picture: gate.wait(10) and bytes([int(picture[0, 0, 0])]))
    encoder = Encoder(lambda jpeg, captured: seen.append((jpeg[0], captured)))
    for i in range(50):
        encoder.put(torch.full((3, 2, 2), i, dtype=torch.uint8), float(i))
    gate.set()
    for _ in range(1000):
        if seen and seen[-1][0] == 49:
            break
        gate.wait(0.01)
        threading.Event().wait(0.005)
    encoder.close()
    assert seen[-1] == (49, 49.0) and len(seen) <= 3


def test_no_picture_is_encoded_while_nobody_looks():
    async def run():
        async with PageServer(THESIS, CAMERA, port=0) as server:
            server.see(SMOOTH, Pose.refused(Status.NO_CATHETER, "none"), 1.0)
            return server._encoders

    assert asyncio.run(run()) == {}


def test_a_file_is_played_again_and_again_at_its_pace(tmp_path):
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((8, 10, 3), 40 * i, np.uint8))
    came, enough = [], threading.Event()

    def put(picture, captured):
        came.append((int(picture[0, 0, 0]), captured, now()))
        if len(came) == 7:
            enough.set()

    panel = PanelSource(str(tmp_path))
    panel.start(put)
    assert enough.wait(20)
    panel.close()
    assert [value for value, _, _ in came[:7]] == [0, 40, 80, 0, 40, 80, 0]
    assert all(abs(arrived - captured) < 0.5 for _, captured, arrived in came)
    assert 1.9 / 30 < came[2][1] - came[0][1] < 2.1 / 30


def test_a_jpeg_needs_a_picture():
    with pytest.raises(ValueError, match=r"uint8 of shape \[3, H, W\], got torch.float32"):
        encode_jpeg(torch.zeros(3, 4, 4))
    with pytest.raises(ValueError, match="quality"):
        encode_jpeg(SMOOTH, 0)


# ---- registered volumes

REGISTRATION = """
volume: {{path: {path}, spacing: {spacing}}}
frame_from_volume: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.4], [0, 0, 0, 1]]
window: 100
"""


def test_a_registered_volume_is_read_and_its_samples_served(tmp_path):
    values = np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6) - 40
    np.save(tmp_path / "ct.npy", values)
    file = tmp_path / "registration.yaml"
    file.write_text(REGISTRATION.format(path=tmp_path / "ct.npy", spacing="[0.001, 0.002, 0.003]"))
    volume = load_registered(file)
    assert (volume.low, volume.high, volume.window, volume.level) == (-40, 79, 100, 19.5)
    torch.testing.assert_close(volume.samples.double(), (torch.tensor(values) + 40).double() / 119, rtol=0, atol=1e-3)
    point = torch.tensor([0.1 + 2 * 3e-3, 3 * 2e-3, 0.4 + 1e-3, 1.0], dtype=torch.float64)  # sample z 1, y 3, x 2
    wanted = torch.tensor([2.5 / 6, 3.5 / 5, 1.5 / 4, 1.0], dtype=torch.float64)
    torch.testing.assert_close(volume.texture_from_frame @ point, wanted)

    async def run():
        async with PageServer(THESIS, port=0, volume=volume) as server, aiohttp.ClientSession() as session:
            async with session.ws_connect(server.address + "poses") as socket:
                setup = await socket.receive_json()
            async with session.get(server.address + "volume") as answer:
                return setup["volume"], await answer.read()

    setup, data = asyncio.run(run())
    assert setup["shape"] == [4, 5, 6] and setup["level"] == 19.5
    assert np.array_equal(np.frombuffer(data, np.float16).reshape(4, 5, 6), volume.samples.numpy())


def test_a_long_axis_is_averaged_and_keeps_its_place():
    values = torch.arange(600.0).expand(2, 3, 600)
    found = register(Volume(values, (1e-3, 1e-3, 1e-3), "m"), torch.eye(4, dtype=torch.float64))
    assert found.samples.shape == (2, 3, 256)
    at = (torch.arange(256) + 0.5) / 256  # coordinate of each sample between the faces
    assert (found.samples[0, 0].double() * 599 - (600 * at.double() - 0.5)).abs().max() < 1


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[1, 0, 0, 0.1]", "[2, 0, 0, 0.1]", "rotation without mirroring"),
        ("spacing: [0.001, 0.002, 0.003]", "spacing: [1, 2, 3], unit: relative", "size in metres is unknown"),
        ("window: 100", "window: 0", "window"),
        ("ct.npy", "none.npy", "none.npy"),
        ("window: 100", "windov: 100", "windov"),
    ],
)
def test_what_cannot_be_registered_is_said(tmp_path, old, new, match):
    np.save(tmp_path / "ct.npy", np.zeros((2, 2, 2), np.float32))
    text = REGISTRATION.format(path=tmp_path / "ct.npy", spacing="[0.001, 0.002, 0.003]")
    assert old in text
    (tmp_path / "registration.yaml").write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=match):
        load_registered(tmp_path / "registration.yaml")


def test_bad_options_of_the_page_are_said(tmp_path):
    with pytest.raises(ConfigError, match="--panel: no such video, folder or camera: none.mp4.*pattern"):
        open_page("a.mp4", panel="none.mp4")
    with pytest.raises(ConfigError, match="give one"):
        open_page("a.mp4", align=tmp_path / "a.yaml", headset=tmp_path / "b.yaml")
    (tmp_path / "a.yaml").write_text("headset_from_camera: 3\n")
    with pytest.raises(ConfigError, match="a.yaml"):
        open_page("a.mp4", align=tmp_path / "a.yaml")
