"""A traverse after encoding and decoding by a video codec: what a user without descriptors would store."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.traverse import Part
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import InputError, Traverse

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

DECODERS = {"libx264": "h264", "libx265": "hevc"}
BATCH = 64
WITHOUT_END = 10**6  # frames between key frames: only the first is one


class CodedVideo(Traverse):
    """Every step-th frame of a traverse, reduced, encoded, decoded, and enlarged again.

    codec: "libx264" or "libx265"; ValueError if it is not installed. crf: its quality, from 0 (best) to 51.
    longest: pixels of the longer side of the reduced frames. bytes: of all packets.
    """

    def __init__(self, traverse: Traverse, codec: str, crf: int, step: int = 1, longest: int = 64) -> None:
        import av

        if len(traverse.frame_shape) != 3:
            raise InputError(f"{traverse.name} holds ready features; expected frames, which a codec needs")
        height, width = traverse.frame_shape[1:]
        self.name, self.size = f"{traverse.name} by {codec}", (height, width)
        scale = min(1.0, longest / max(height, width))
        # even sides, since colours have half the resolution
        small = tuple(max(8, 2 * round(side * scale / 2)) for side in (height, width))
        encoder, decoder = _context(codec, "w"), _context(DECODERS[codec], "r")
        encoder.height, encoder.width = small
        encoder.pix_fmt, encoder.time_base, encoder.framerate = "yuv420p", Fraction(1, 25), Fraction(25)
        encoder.options = {"crf": str(crf), "preset": "slow", "g": str(WITHOUT_END)}
        if codec == "libx265":
            encoder.options |= {"x265-params": "log-level=none:info=0"}
        packets, count = [], 0
        for batch in Part(traverse, range(0, len(traverse), step)).batches(BATCH):
            for pixels in _pixels(batch, small):
                frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                frame.pts, count = count, count + 1
                packets += encoder.encode(frame)
        packets += encoder.encode(None)
        self.bytes = sum(packet.size for packet in packets)
        decoded = [frame for packet in [*packets, None] for frame in decoder.decode(packet)]
        self.frames = ArrayTraverse(np.stack([frame.to_ndarray(format="rgb24") for frame in decoded]))
        if len(self) != count:
            raise InputError(f"{codec} returned {len(self)} frames; expected {count}")

    def __len__(self) -> int:
        return len(self.frames)

    def read(self, frames: range | list[int]) -> Tensor:
        return resize_frames(self.frames.read(frames), self.size)


def _context(codec: str, mode: Literal["r", "w"]) -> VideoCodecContext:
    from av import CodecContext

    return cast("VideoCodecContext", CodecContext.create(codec, mode))


def _pixels(batch: Tensor, size: tuple[int, ...]) -> np.ndarray:
    """Frames (B,C,H,W) in [0,1] as (B,height,width,3) uint8."""
    small = resize_frames(batch, (size[0], size[1])).clamp(0, 1)
    colour = small[:, :3] if small.shape[1] >= 3 else small[:, :1].expand(-1, 3, -1, -1)
    return (255 * colour).round().to(torch.uint8).permute(0, 2, 3, 1).contiguous().numpy()
