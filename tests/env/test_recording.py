import numpy as np
import pytest
from PIL import Image

from probe_kit.env.recording import save_gif


def test_a_recording_has_every_picture_and_plays_in_real_time(tmp_path):
    pictures = [np.full((48, 64, 3), shade, np.uint8) for shade in (0, 90, 180, 250)]
    save_gif(tmp_path / "episode.gif", pictures, fps=5)
    with Image.open(tmp_path / "episode.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"], gif.info["loop"]) == (4, (64, 48), 200, 0)
        gif.seek(2)
        assert gif.convert("RGB").getpixel((5, 5)) == (180, 180, 180)


def test_a_recording_of_nothing_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no pictures"):
        save_gif(tmp_path / "empty.gif", [])
    assert not (tmp_path / "empty.gif").exists()
