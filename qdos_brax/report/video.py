"""Videos: H.264 in .mp4 files, and small animated WebP images that a page can hold."""

from __future__ import annotations

import contextlib
import io
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import PIL.Image

from qdos_brax.errors import UserError
from qdos_brax.files import replacing

_QUALITY = 35  # of WebP, 0 to 100
_EFFORT = 1  # of WebP, 0 to 6: half the time of the default, a third more bytes


@contextlib.contextmanager
def mp4(out: Path, height: int, width: int, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Write a video; yield the function that takes its frames uint8[height, width, 3], one by one.

    The file appears when the block ends without an error, and not at all otherwise.

    Args:
        out: the file, ending in .mp4; its folder must exist.
        height: height of the frames in pixels; H.264 needs even numbers, so an odd one loses a row.
        width: width of the frames in pixels; an odd one loses a column.
        fps: frames per second.

    Raises:
        UserError: imageio-ffmpeg is not installed, or the file cannot be written.
    """
    if out.suffix != ".mp4":
        raise UserError(f"a video is written as .mp4, not as {out.name}; choose another name for it")
    ffmpeg = _ffmpeg()
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    coding = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2"]
    with replacing(out) as partial:  # of the same ending, from which ffmpeg takes the format
        partial.touch()  # raises at once, with the reason, if it cannot be written
        # imageio_ffmpeg.write_frames runs Python between fork and exec, where other threads (JAX has some) can make it
        # hang. process_group keeps Ctrl-C away from ffmpeg without that.
        with subprocess.Popen(
            [ffmpeg, "-v", "error", "-y", *source, *coding, str(partial)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,
        ) as process:
            assert process.stdin is not None
            feed = process.stdin
            try:
                yield lambda frame: _send(feed, frame)
            except BaseException:
                process.kill()
                with contextlib.suppress(BrokenPipeError):  # some frames may still be unsent
                    feed.close()
                raise
            _, errors = process.communicate()
        if process.returncode:
            raise UserError(f"cannot write {out}: ffmpeg says {' '.join(errors.decode(errors='replace').split())}")


def webp(frames: np.ndarray, fps: float) -> bytes:
    """Return an animated WebP image that plays again and again.

    Args:
        frames: uint8[T, height, width, 3].
        fps: frames per second.
    """
    first, *others = map(PIL.Image.fromarray, frames)
    content = io.BytesIO()
    style = {"duration": round(1000 / fps), "loop": 0, "quality": _QUALITY, "method": _EFFORT}
    first.save(content, "WEBP", save_all=True, append_images=others, **style)
    return content.getvalue()


def _send(feed: IO[bytes], frame: np.ndarray) -> None:
    with contextlib.suppress(BrokenPipeError):  # ffmpeg has stopped; its reason is read at the end
        feed.write(np.ascontiguousarray(frame, np.uint8).tobytes())


def _ffmpeg() -> str:
    """Return the path of ffmpeg."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:  # RuntimeError: no ffmpeg for this kind of machine
        raise UserError(
            f'videos need ffmpeg ({error}); run: pip install -c constraints.txt -e ".[video]", '
            "or set IMAGEIO_FFMPEG_EXE to an ffmpeg of your own"
        ) from error
