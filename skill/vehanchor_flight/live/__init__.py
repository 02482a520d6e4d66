"""Scale of a running camera: one filter over log scale.

The cars of a frame measure the scale, and features give its ratio to the frame before.

frames -> newest frame -> features -> ratio to the frame before -> search of one window -> filter
-> record
"""
