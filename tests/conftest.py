"""What holds for every test: MuJoCo's OpenGL is chosen before anything imports mujoco (ManiSkill's kinematics do)."""

from manicm_ms import mujoco_gl

mujoco_gl.prepare()
