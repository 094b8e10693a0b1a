"""The method of the preset `clinic`: the organ of the CT, laid on a cloud of one side.

Read ``registration`` first; it is the whole method and names the steps.
"""
