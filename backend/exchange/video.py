"""Video encoding of a LeRobot dataset: H.264, quality 10, at least one key frame in ten images."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from touchdown.backend.core import ImageArray, require_package
from touchdown.backend.exchange.features import FPS

VIDEO_MB = 200
CODEC: dict[str, object] = {
    "codec": "h264", "crf": 10, "gop": 10, "pix_fmt": "yuv420p", "preset": "veryfast",
    "bf": 0,  # no picture refers to a later one: Rerun shows such videos only with FFmpeg
}  # fmt: skip
PLAYABLE = {"movflags": "+faststart"}  # the index before the pictures: browsers play at once
HEIGHT, WIDTH = 240, 320
CHUNK_FILES = 1000


class VideoWriter:
    """Videos of one camera, a new file above 200 MB."""

    def __init__(self, folder: Path, pattern: str, key: str) -> None:
        self._folder, self._pattern, self._key = folder, pattern, key
        self._container: Any = None
        self._stream: Any = None
        self._file, self._frames, self._bytes = -1, 0, 0

    @staticmethod
    def feature() -> dict[str, Any]:
        """Return the entry of ``info.json``."""
        return {
            "dtype": "video",
            "shape": [HEIGHT, WIDTH, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": HEIGHT,
                "video.width": WIDTH,
                "video.codec": CODEC["codec"],
                "video.pix_fmt": CODEC["pix_fmt"],
                "video.is_depth_map": False,
                "video.fps": FPS,
                "video.channels": 3,
                "has_audio": False,
                "is_depth_map": False,
            },
        }

    def add(self, pictures: Sequence[ImageArray]) -> dict[str, Any]:
        """Append the images (h, w, 3) RGB of an episode; return their position."""
        if self._container is None or self._bytes > VIDEO_MB * 1_000_000:
            self._next_file()
        start = self._frames
        av = require_package("av")
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = self._frames
            frame.time_base = Fraction(1, FPS)
            self._write(self._stream.encode(frame))
            self._frames += 1
        chunk, number = divmod(self._file, CHUNK_FILES)
        return {
            f"videos/{self._key}/chunk_index": chunk,
            f"videos/{self._key}/file_index": number,
            f"videos/{self._key}/from_timestamp": start / FPS,
            f"videos/{self._key}/to_timestamp": self._frames / FPS,
        }

    def close(self) -> None:
        """Finish the file."""
        if self._container is not None:
            self._write(self._stream.encode())
            self._container.close()
            self._container = None

    def _write(self, packets: Any) -> None:
        for packet in packets:
            self._bytes += packet.size
            self._container.mux(packet)

    def _next_file(self) -> None:
        self.close()
        self._file, self._frames, self._bytes = self._file + 1, 0, 0
        chunk, number = divmod(self._file, CHUNK_FILES)
        name = self._pattern.format(video_key=self._key, chunk_index=chunk, file_index=number)
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = require_package("av").open(str(path), "w", options=PLAYABLE)
        # one thread: the same images give the same file
        options = {name: str(CODEC[name]) for name in ("crf", "preset", "bf")}
        options |= {"g": str(CODEC["gop"]), "threads": "1"}
        stream = self._container.add_stream("libx264", rate=FPS, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, CODEC["pix_fmt"]
        stream.time_base = Fraction(1, FPS)
        self._stream = stream
