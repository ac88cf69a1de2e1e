"""What is on people's disks, as recordings: `tactile-rt import`.

    wire         logs of a serial line or a CAN bus, decoded by a codec
    table_form   tables of numbers in text: delimiter, decimal mark, header
    table_guess  which of their columns are times and channels, and in which order dates stand
    bag          topics of ROS 1 and ROS 2 bags, which bag_file opens and mends
    table        what the last two share: columns in words, times, a recording of them

What comes out is there whole or not at all, and says what was lost on the way.
"""
