"""The rules of wildlife monitoring in plain Python, one world and one body after the other."""

import numpy as np

MOVES = [(0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)]  # rest, up, right, down, left

Cell = tuple[int, int]


def round_the_torus(cell: Cell, width: int, height: int) -> Cell:
    x, y = cell
    while x > width // 2:
        x -= width
    while x < -(width // 2):
        x += width
    while y > height // 2:
        y -= height
    while y < -(height // 2):
        y += height
    return x, y


def picture(drone: Cell, poacher: Cell, width: int, height: int) -> np.ndarray:
    """The torus around a drone: itself a plus in the middle, the poacher an x."""
    image = np.zeros((3 * height, 3 * width), np.float32)
    row, column = 3 * (height // 2) + 1, 3 * (width // 2) + 1
    for down, right in [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]:
        image[row + down, column + right] = 1
    x, y = round_the_torus((poacher[0] - drone[0], poacher[1] - drone[1]), width, height)
    row, column = row - 3 * y, column + 3 * x
    image[row - 1 : row + 2, column - 1 : column + 2] = 0
    for down, right in [(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
        image[row + down, column + right] = 1
    return image


def observation(drones: list[Cell], poacher: Cell, i: int, width: int, height: int, corrected: bool) -> np.ndarray:
    numbers = list(picture(drones[i], poacher, width, height).flatten())
    for j, other in enumerate(drones):
        if j != i:
            way = other[0] - drones[i][0], other[1] - drones[i][1]
            numbers += round_the_torus(way, width, height) if corrected else way
    return np.array(numbers, np.float32)


def step(
    drones: list[Cell], poacher: Cell, actions: list[int], poacher_move: Cell, width: int, height: int, corrected: bool
) -> tuple[list[Cell], Cell, float, bool]:
    """Return the drones' cells, the poacher's cell, the reward of every drone, and whether the poacher is trapped."""

    def moved(cell: Cell, move: Cell) -> Cell:
        return round_the_torus((cell[0] + move[0], cell[1] + move[1]), width, height)

    wanted = [moved(cell, MOVES[action]) for cell, action in zip(drones, actions, strict=True)]
    bumped = [wanted.count(cell) > 1 for cell in wanted]
    after = [old if back else new for old, new, back in zip(drones, wanted, bumped, strict=True)]
    poacher_after = moved(poacher, poacher_move)
    hunted = poacher_after if corrected else poacher
    above, beside = [], []
    for i, cell in enumerate(after):
        way = cell[0] - hunted[0], cell[1] - hunted[1]
        if corrected:
            way = round_the_torus(way, width, height)
        distance = abs(way[0]) + abs(way[1])
        if distance == 0:
            above.append(i)
        if distance == 1 and not bumped[i]:
            beside.append(i)
    trapped = len(above) == 1 and len(beside) > 0
    rewards = [-0.05 / len(drones)] * len(drones)
    if trapped:
        for i in above + beside:
            rewards[i] += 1
    return after, poacher_after, sum(rewards), trapped
