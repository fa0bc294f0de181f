"""How the line detector is judged: drawn scenes, photographs, a scorer and rival methods, in one table.

`python -m tests.lines` prints the table. `scenes` draws pictures with exact centre-lines; `recipes` says of what:
`paths` has the shapes of lines, `floors` what lies under them, `tape` what they are made of, `light` what lamps and
camera do. `photographs` reads a folder of real pictures with annotations, `peers` has the rival methods, and `score`
compares what any of them returns with the truth.
"""
