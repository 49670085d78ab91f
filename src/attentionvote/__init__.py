"""attentionvote: from a part's CAD file to a verified 6D pose model.

Conventions, stated once and tested once (``tests/test_conventions.py``):

* metres, radians, seconds everywhere; a name that carries another unit says so (``_mm``);
* quaternions are ``(w, x, y, z)``;
* transforms are named ``target_from_source``: ``camera_from_part @ p_part = p_camera``;
* the camera frame is OpenCV's: x right, y down, z forward;
* arrays are channels last, ``(batch, points, channels)`` at every public function;
* random functions take an explicit ``rng``;
* the order of the points of a sample is random, so that "the first k in index order" is a uniform
  sample of a ball: that is what a ball query returns, in training, export and tests alike.
"""

__version__ = "0.2.0"
