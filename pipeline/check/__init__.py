"""The data doctor: says what is wrong with a data set or an exported folder, and stays silent when nothing is."""
