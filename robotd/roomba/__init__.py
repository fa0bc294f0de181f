"""What the Roomba driver is made of: parts that know the robot and its line, but neither bus nor supervisor."""
