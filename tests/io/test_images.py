import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from paths import SHARED

from holotorch.io.bundled import BUNDLED_IMAGES
from holotorch.io.images import encode_png, fit_image, load_image, with_channels


@pytest.mark.parametrize("name", BUNDLED_IMAGES)
def test_every_bundled_photograph_loads(name):
    image = load_image(name)
    assert image.dtype == torch.float64 and image.shape[0] in (1, 3)
    assert image.min() >= 0 and 0.4 < image.max() <= 1


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 256, (13, 17, 3), dtype=np.uint8)


@pytest.mark.parametrize("suffix", ["png", "tiff"])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_lossless_files_come_back_in_red_green_blue(tmp_path, pixels, suffix, depth):
    values = pixels.astype(depth) * (257 if depth is np.uint16 else 1)
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), values[..., ::-1])
    np.testing.assert_allclose(load_image(tmp_path / f"a.{suffix}").permute(1, 2, 0), pixels / 255, rtol=1e-15)


def test_grey_colour_jpeg_and_transparency(tmp_path, pixels):
    cv2.imwrite(str(tmp_path / "grey.png"), pixels[..., 0])
    assert load_image(tmp_path / "grey.png").shape == (1, 13, 17)
    smooth = np.full((16, 16, 3), (200, 100, 50), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "flat.jpg"), smooth[..., ::-1])
    np.testing.assert_allclose(load_image(tmp_path / "flat.jpg")[:, 8, 8] * 255, (200, 100, 50), atol=3)
    alpha = np.dstack([pixels[..., ::-1], np.full((13, 17), 51, dtype=np.uint8)])
    cv2.imwrite(str(tmp_path / "clear.png"), alpha)
    np.testing.assert_allclose(load_image(tmp_path / "clear.png").permute(1, 2, 0), pixels / 255 * 0.2, rtol=1e-12)


def write_exr(path, **channels):
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))


def test_wide_integers_are_scaled_by_their_own_maximum(tmp_path, pixels):
    # A 32 bit picture that holds 0 to 255 is not a black one.
    cv2.imwrite(str(tmp_path / "wide.tiff"), pixels[..., 0].astype(np.int32))
    np.testing.assert_allclose(load_image(tmp_path / "wide.tiff")[0], pixels[..., 0] / pixels[..., 0].max())


def test_a_jpeg_by_another_name_is_still_a_jpeg(tmp_path, pixels):
    cv2.imwrite(str(tmp_path / "a.jpg"), pixels)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.jpg").read_bytes())
    torch.testing.assert_close(load_image(tmp_path / "a.png"), load_image(tmp_path / "a.jpg"))


def test_exr_transparency_and_stored_differences(tmp_path):
    values = np.random.default_rng(1).random((12, 14), dtype=np.float32)
    write_exr(tmp_path / "a.exr", R=values, G=values, B=values, A=np.full_like(values, 0.25))
    np.testing.assert_allclose(load_image(tmp_path / "a.exr")[1], values * 0.25, rtol=1e-6)
    write_exr(tmp_path / "clear.exr", Y=values, A=np.zeros_like(values))
    with pytest.raises(ValueError, match="is black"):
        load_image(tmp_path / "clear.exr")
    write_exr(tmp_path / "yc.exr", Y=values, RY=values, BY=values)
    with pytest.raises(ValueError, match="luminance and colour differences; convert it to R, G, B"):
        load_image(tmp_path / "yc.exr")


def test_exr_colour_and_grey_and_its_scale(tmp_path):
    values = np.random.default_rng(1).random((3, 12, 14), dtype=np.float32)
    write_exr(tmp_path / "rgb.exr", **dict(zip("RGB", values, strict=True)))
    np.testing.assert_allclose(load_image(tmp_path / "rgb.exr"), values, rtol=1e-7)
    write_exr(tmp_path / "bright.exr", Y=np.ascontiguousarray(values[0] * 7))
    np.testing.assert_allclose(load_image(tmp_path / "bright.exr")[0], values[0] / values[0].max(), rtol=1e-6)
    write_exr(tmp_path / "depth.exr", Z=values[0])
    with pytest.raises(ValueError, match="must have channels R, G, B or Y, got Z"):
        load_image(tmp_path / "depth.exr")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, r"finite, but element \(0, 3, 4\) is nan"),
        (np.inf, "is inf"),
        (-0.5, "negative intensities, down to -0.5"),
    ],
)
def test_refuses_broken_pixels(tmp_path, value, message):
    values = np.full((12, 12), 0.5, dtype=np.float32)
    values[3, 4] = value
    write_exr(tmp_path / "broken.exr", Y=values)
    with pytest.raises(ValueError, match=message):
        load_image(tmp_path / "broken.exr")


def test_refuses_black_tiny_missing_and_garbled_pictures(tmp_path):
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((20, 20), dtype=np.uint8))
    with pytest.raises(ValueError, match="is black throughout; use another picture"):
        load_image(tmp_path / "black.png")
    cv2.imwrite(str(tmp_path / "tiny.png"), np.ones((8, 8), dtype=np.uint8))
    with pytest.raises(ValueError, match="is 8 x 8 px, less than the 11 x 11 px window"):
        load_image(tmp_path / "tiny.png")
    with pytest.raises(ValueError, match="no such picture: 'cofee'; did you mean 'coffee'?"):
        load_image("cofee")
    near = tmp_path / "black.pgn"
    with pytest.raises(ValueError, match=rf"no such picture: '{near}'; did you mean '{tmp_path / 'black.png'}'?"):
        load_image(near)
    for name in ("text.png", "text.exr", "empty.png"):
        (tmp_path / name).write_bytes(b"" if name == "empty.png" else b"not a picture")
        with pytest.raises(ValueError, match="is not a readable"):
            load_image(tmp_path / name)


def test_a_picture_of_the_right_size_is_not_resampled():
    image = torch.rand(3, 12, 17, dtype=torch.float64)
    assert fit_image(image, (12, 17)) is image


@pytest.mark.parametrize("size", [(40, 60), (60, 40), (37, 91), (500, 30)])
@pytest.mark.parametrize("shape", [(20, 20), (16, 48), (48, 16), (11, 13)])
def test_crop_fills_the_frame_and_pad_keeps_the_whole_picture(size, shape):
    image = torch.full((1, *size), 0.7, dtype=torch.float64)
    cropped, padded = fit_image(image, shape, "crop"), fit_image(image, shape, "pad")
    assert cropped.shape == padded.shape == (1, *shape)
    torch.testing.assert_close(cropped, torch.full_like(cropped, 0.7))
    # Padding keeps the aspect: the share of the frame that is filled is the ratio of the aspects.
    ratio = (size[1] / size[0]) / (shape[1] / shape[0])
    filled = padded.sum().item() / 0.7 / shape[0] / shape[1]
    # The frame is rounded to whole pixels of the source: half a pixel in at least 9 of them.
    assert filled == pytest.approx(min(ratio, 1 / ratio), rel=0.06)


def test_resampling_never_overshoots_and_keeps_the_centre():
    image = torch.zeros(1, 100, 100, dtype=torch.float64)
    image[:, :, 50:] = 1
    small = fit_image(image, (25, 25))
    assert small.min() >= 0 and small.max() <= 1
    torch.testing.assert_close(small.flip(-1), 1 - small, rtol=0, atol=1e-12)


def test_unknown_fit():
    with pytest.raises(ValueError, match="fit must be 'crop' or 'pad', got 'stretch'"):
        fit_image(torch.rand(1, 4, 4), (8, 8), "stretch")


def test_channels():
    colour = torch.rand(3, 4, 5, dtype=torch.float64)
    weights = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    torch.testing.assert_close(with_channels(colour, 1)[0], torch.einsum("c,chw->hw", weights, colour))
    assert with_channels(colour[:1], 3).shape == (3, 4, 5)
    assert with_channels(colour, 3) is colour
    with pytest.raises(ValueError, match="cannot show a picture of 3 channels on 2 wavelengths"):
        with_channels(colour, 2)


def test_png_round_trip(tmp_path):
    image = torch.linspace(-0.2, 1.2, 3 * 12 * 13, dtype=torch.float64).view(3, 12, 13)
    (tmp_path / "a.png").write_bytes(encode_png(image))
    torch.testing.assert_close(load_image(tmp_path / "a.png"), image.clamp(0, 1), rtol=0, atol=0.5 / 255 + 1e-12)
    with pytest.raises(ValueError, match="finite"):
        encode_png(image * float("nan"))


def test_shared_photographs_load():

    folder = SHARED / "images"
    if not folder.is_dir():
        pytest.skip("the shared photographs are not beside this checkout; bundled ones cover the same path")
    for path in folder.iterdir():
        assert load_image(path).shape[0] in (1, 3)
