"""What stands in files: task files, robots in URDF and MJCF, effects.yaml; read, checked and written.

`config` (a task file) -> `robotfile` (its robot) -> `urdf`, `mjcf` (by `xmlfile`), `usd` (by `usd_stage`) ->
`assembly` (the tree); back: `export` -> `native` (what a format has a form for), `urdf_text`, `mjcf_text`.
`mujoco_model` compiles a robot for MuJoCo.
"""
