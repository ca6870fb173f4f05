"""How far labels and images disagree in disparity, car by car (see judge_label_disparity.py)."""
