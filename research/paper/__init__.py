"""The paper's baselines: language models, agents and question sets, and its benchmark of areas."""
