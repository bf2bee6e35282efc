import dataclasses
import hashlib
import http.server
import json
import re
import socket
import threading

import numpy as np
import pytest
from paths import SHARED

from holotorch.io import catalogue
from holotorch.io.catalogue import PUBLISHED, Published, fetch_volume
from holotorch.io.volumes import load_volume


@pytest.fixture
def server(tmp_path):
    """A folder behind a web server on this machine, and the list of what was asked from it."""
    folder, asked = tmp_path / "web", []
    folder.mkdir()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *arguments):
            super().__init__(*arguments, directory=str(folder))

        def log_message(self, format, *arguments):
            asked.append(self.path)

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield folder, asked, f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


@pytest.fixture
def values():
    return np.random.default_rng(2).integers(0, 256, (4, 5, 6), dtype=np.uint8)


@pytest.fixture
def published(server, values, monkeypatch):
    folder, asked, url = server
    (folder / "dot_6x5x4_uint8.raw").write_bytes(values.tobytes())
    digest = hashlib.sha512(values.tobytes()).hexdigest()
    entry = Published(f"{url}/dot_6x5x4_uint8.raw", (4, 5, 6), "uint8", digest, "")
    monkeypatch.setitem(PUBLISHED, "dot", entry)
    return folder, asked


def test_fetched_once_and_loaded(published, values, tmp_path):
    for _ in range(2):
        volume = fetch_volume("dot", tmp_path / "cache")
        np.testing.assert_array_equal(volume.values.numpy(), values)
        assert volume.spacing == (1, 1, 1) and volume.unit == "relative"
    assert published[1] == ["/dot_6x5x4_uint8.raw"]


def test_other_content_is_refused_and_not_kept(published, values, tmp_path):
    (published[0] / "dot_6x5x4_uint8.raw").write_bytes(values.tobytes()[::-1])
    with pytest.raises(ValueError, match="(?i)hash"):
        fetch_volume("dot", tmp_path / "cache")
    assert not list((tmp_path / "cache").glob("*.raw"))
    # A damaged copy is fetched again.
    (published[0] / "dot_6x5x4_uint8.raw").write_bytes(values.tobytes())
    (tmp_path / "cache" / "dot_6x5x4_uint8.raw").write_bytes(b"damaged")
    np.testing.assert_array_equal(fetch_volume("dot", tmp_path / "cache").values.numpy(), values)


def test_what_could_not_be_fetched_is_not_asked_for_again_until_it_is_there(published, values, tmp_path):
    web, asked = published
    (web / "dot_6x5x4_uint8.raw").unlink()
    messages, counts = [], []
    for folder in ("cache", "cache", "cache", "elsewhere"):  # another folder is another question
        with pytest.raises(OSError, match="404") as caught:
            fetch_volume("dot", tmp_path / folder)
        messages.append(str(caught.value))
        counts.append(len(asked))
    assert messages[0] == messages[1] == messages[2] != messages[3]
    assert 0 < counts[0] == counts[1] == counts[2] < counts[3]
    (tmp_path / "cache" / "dot_6x5x4_uint8.raw").write_bytes(values.tobytes())
    np.testing.assert_array_equal(fetch_volume("dot", tmp_path / "cache").values.numpy(), values)


def test_without_a_network_the_message_is_short(published, tmp_path, monkeypatch):
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))  # bound and not listening: connections are refused
        url = f"http://127.0.0.1:{one.getsockname()[1]}/dot_6x5x4_uint8.raw"
        monkeypatch.setitem(PUBLISHED, "dot", dataclasses.replace(PUBLISHED["dot"], url=url))
        with pytest.raises(OSError) as caught:
            fetch_volume("dot", tmp_path)
    place = tmp_path / "dot_6x5x4_uint8.raw"
    assert str(caught.value) == f"could not fetch {url} (no connection); download it and put it at {place}"


def test_without_a_server_it_says_where_to_put_the_file(published, values, tmp_path):
    (published[0] / "dot_6x5x4_uint8.raw").unlink()
    place = tmp_path / "cache" / "dot_6x5x4_uint8.raw"
    with pytest.raises(
        OSError, match=f"could not fetch http://127.*404.*download it and put it at {re.escape(str(place))}"
    ):
        fetch_volume("dot", tmp_path / "cache")
    place.parent.mkdir(exist_ok=True)
    place.write_bytes(values.tobytes())
    np.testing.assert_array_equal(fetch_volume("dot", place.parent).values.numpy(), values)


def test_default_place_is_the_cache_of_the_user(published, tmp_path, monkeypatch):
    import pooch

    monkeypatch.setattr(pooch, "os_cache", lambda project: tmp_path / project)
    fetch_volume("dot")
    assert (tmp_path / "holotorch" / "dot_6x5x4_uint8.raw").is_file()


def test_unknown_names():
    with pytest.raises(
        ValueError, match="'teapot'; did you mean 'boston_teapot'. known are tooth, boston_teapot, bonsai"
    ):
        fetch_volume("teapot")
    with pytest.raises(ValueError, match="no such published volume: 'hand'; known are .*Load others with load_volume"):
        fetch_volume("hand")


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_entries_are_consistent(name):
    entry = PUBLISHED[name]
    x, y, z, dtype = re.fullmatch(r".*/\w+_(\d+)x(\d+)x(\d+)_(\w+)\.raw", entry.url).groups()  # type: ignore[union-attr]
    assert entry.shape == (int(z), int(y), int(x)) and entry.dtype == dtype
    assert re.fullmatch(r"[0-9a-f]{128}", entry.sha512) and catalogue._ORIGIN in entry.url


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_entries_agree_with_the_shared_copies(name):
    if not SHARED.is_dir():
        pytest.skip("the shared volumes are not beside this checkout; entries are checked for consistency above")
    entry = PUBLISHED[name]
    voxels = load_volume(SHARED / "volumes" / f"{name}.nrrd", shape=entry.shape, dtype=entry.dtype).values
    assert hashlib.sha512(voxels.numpy().tobytes()).hexdigest() == entry.sha512
    listed = {item["file"]: item for item in json.loads((SHARED / "manifest.json").read_text())["files"]}
    assert listed[f"volumes/{name}.nrrd"]["public"].startswith(entry.url)
