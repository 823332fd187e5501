"""Validation (`brushloop validate`): every model compared with every captured press, and the report.

Used by `analyse` and the demo; reads sessions and fits, and writes only the folder of the validation.
"""
