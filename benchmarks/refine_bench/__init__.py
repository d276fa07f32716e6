"""Evaluation of refinement: cases with known answers, and the tables of the paper."""
