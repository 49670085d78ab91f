"""Pure geometry in numpy and scipy: poses, symmetries, point clouds, neighbourhoods."""
