"""Draw a ``.rrd`` recording as the Rerun viewer shows it, without a display, into a small PNG.

    python tools/screenshot.py RECORDING.rrd PICTURE.png

Needs the extra ``[view]`` and a Vulkan driver; on Debian the software one is the package
``mesa-vulkan-drivers``.
"""

import io
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import rerun_cli
from PIL import Image
from rerun.experimental import ViewerClient

SIZE = "1400x1000"
TOP_BAR = 36  # pixels of menu and warnings about the software renderer, cut off
COLOURS = 128
LOADING_S = 30.0
SETTLING_S = 2.0  # the plots appear some frames after the data has arrived


def main(recording: Path, picture: Path) -> None:
    """Start a viewer on loopback, wait until it has drawn, take the picture, end it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    viewer = Path(rerun_cli.__file__).with_name("rerun")
    options = ["--bind", "127.0.0.1", "--port", str(port), "--window-size", SIZE]
    # Where CI is set Rerun sends no usage statistics; its own log would show in the picture.
    quiet = {**os.environ, "CI": "1", "RUST_LOG": "error"}
    process = subprocess.Popen([viewer, "--headless", *options, recording], env=quiet)
    try:
        picture.write_bytes(shrink(drawn(f"rerun+http://127.0.0.1:{port}/proxy")))
    finally:
        process.terminate()
        process.wait()


def drawn(address: str) -> bytes:
    """Wait until the recording is loaded and drawn; give the viewer's picture as PNG."""
    end = time.monotonic() + LOADING_S
    while True:
        try:
            client = ViewerClient.connect(address)
            state = client.get_state()
            if state.recordings and not state.loading:
                break
        except (ConnectionError, RuntimeError):
            pass  # the viewer has not started yet
        if time.monotonic() > end:
            sys.exit("the viewer did not load the recording")
        time.sleep(0.2)
    client.set_time(play_state="following")  # the cursor goes to the end, out of the way
    time.sleep(SETTLING_S)
    return client.take_screenshot()


def shrink(png: bytes) -> bytes:
    """Reduce it to a palette: a tenth of the size, without a visible difference in a plot."""
    out = io.BytesIO()
    image = Image.open(io.BytesIO(png)).convert("RGB")
    image = image.crop((0, TOP_BAR, *image.size))
    image.quantize(COLOURS).save(out, "PNG", optimize=True)
    return out.getvalue()


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
