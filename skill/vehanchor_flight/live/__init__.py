"""Scale of a running camera: one filter over log scale, from the cars of the frames and the ratios between them.

frames -> newest frame -> features -> ratio to the frame before -> search of one window -> filter ->
reading
"""
