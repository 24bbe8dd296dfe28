"""Groups of measures beyond the standard ones: `pnpdepth eval --measures`.

One file adds one group, a `MeasureGroup` called `GROUP`; `choices.MEASURE_GROUPS` finds it.
"""
