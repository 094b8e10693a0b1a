"""The canonical warp: where the pre-operative organ lies and how it is deformed.

A network looks at the cloud once and says pose and elastic state (``network``); a few
Gauss-Newton steps then lay the organ's surface on the observed points (``refine``). Labels are
read in the pre-operative frame (``shape``), so tumors keep their form and every point of the CT
has its place now (``motion``).
"""
