"""The vocabulary of manager-based tasks: plain functions of the environment, one module a section of the YAML.

Shapes are given after each summary; joint quantities are in m and rad, efforts in N and N m. Names and meanings follow
Isaac Lab's `mdp` module.
"""
