"""Films, as H.264 in .mp4."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from qdos_brax.errors import UserError
from qdos_brax.files import user_errors


@contextlib.contextmanager
def mp4(out: Path, height: int, width: int, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Writes a film: gives the function that takes its frames uint8[height, width, 3], one by one.

    The file appears under its name when the block ends well, and not at all if it does not.

    Args:
        out: the file, ending in .mp4; its folder must exist.
        height: of the frames; an odd one loses a row, for H.264 wants even numbers.
        width: of the frames; likewise.
        fps: frames per second.

    Raises:
        UserError: imageio-ffmpeg is not installed, or the file cannot be written.
    """
    if out.suffix != ".mp4":
        raise UserError(f"a film is written as .mp4, not as {out.name}; choose another name for it")
    ffmpeg = _ffmpeg()
    partial = out.with_name(f".{out.stem}.partial.mp4")  # ffmpeg goes by the ending
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    coding = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2"]
    with user_errors(out):
        partial.touch()  # says at once, and why, if it cannot be written
        try:
            # imageio_ffmpeg.write_frames would run Python between fork and exec, where threads such as JAX's can hang
            # it; process_group keeps a Ctrl-C from ffmpeg without that.
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
                    with contextlib.suppress(BrokenPipeError):  # of what was still to be sent
                        feed.close()
                    raise
                _, said = process.communicate()
            if process.returncode:
                raise UserError(f"cannot write {out}: ffmpeg says {' '.join(said.decode(errors='replace').split())}")
            os.replace(partial, out)
        finally:
            partial.unlink(missing_ok=True)


def _send(feed: IO[bytes], frame: np.ndarray) -> None:
    with contextlib.suppress(BrokenPipeError):  # ffmpeg has stopped; why, it says at the end
        feed.write(np.ascontiguousarray(frame, np.uint8).tobytes())


def _ffmpeg() -> str:
    """The path of ffmpeg."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:  # RuntimeError: there is none for this kind of machine
        raise UserError(
            f'films need ffmpeg ({error}); run: pip install -c constraints.txt -e ".[video]", '
            "or set IMAGEIO_FFMPEG_EXE to an ffmpeg of your own"
        ) from error
