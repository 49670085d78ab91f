"""Methods without learning that a user would take today, measured beside the network.

OpenCV and Open3D are imported only when a detector is made; the one comes with the extra ``benchmark``, the other with
``train``.
"""
