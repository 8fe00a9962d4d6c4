"""Robots as ManiSkill agents, one file each."""
