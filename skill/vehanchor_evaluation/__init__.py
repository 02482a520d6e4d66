"""Evaluation of VehAnchor on data of known truth."""
