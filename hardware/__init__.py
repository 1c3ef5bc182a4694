"""The head as parts that can be made: its mount and stand, the boards, what is bought.

Everything follows from the same lens systems, wiring and data files as the rest of the project.
Nothing heavy is loaded before it is asked for.
"""
