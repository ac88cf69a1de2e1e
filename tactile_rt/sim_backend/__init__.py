"""Whisker arrays, objects and sweeps simulated in MuJoCo (extra ``sim``).

arrays/  ---->  world  -->  sweep, whisking  -->  sensor  -->  source    (a live stream)
objects/ --'                                       \\-->  datasets/       (sweeps on disk)
                                                    `->  views/          (pictures, films)
"""
