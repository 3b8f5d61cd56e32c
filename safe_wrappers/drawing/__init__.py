"""Pictures of what a filter knows: shapes as plain data, in MuJoCo's scene, and a strip on the frame."""
