"""Robots as ManiSkill agents; importing a module registers its agent."""
