"""Who owns what in `cluster_kernels`: how control nodes and grid are divided among the blocks of a cluster."""

from typing import NamedTuple

import numpy as np

BLOCK = 256  # threads of a block; with more there are too few registers
CLUSTERS = (16, 8, 4, 2, 1)  # blocks
WARP = 32
ROUNDS = 4  # of a block's threads over its patch, or over what it sends
AT_ONCE = 4  # loads of a thread that adds up
BANKS = 8  # of shared memory, for fours: those of eight threads that load or store at once should differ
SHARED = 14_000  # fours of float32 in shared memory
OTHERS = 4096  # bytes of it that Warp and the GPU's own take at most


class Division(NamedTuple):
    """How the nodes and the grid are divided among the C blocks of a cluster.

    All are tables int32. Places in shared memory are numbers of fours; those in the inbox count from its beginning.
    """

    lanes: int  # that share a node
    slots: int  # fours that hold what nodes give; the last is for lanes that have nothing to give
    inbox: int  # fours; the first are the totals of the patch, the last is zero
    nodes: np.ndarray  # [C, P] nodes of each piece, -1 = none
    corners: np.ndarray  # [C, P, 27] number in its patch of each node's grid nodes
    slot_of: np.ndarray  # [C, P, 27] slot of what it gives to each of these
    sums: np.ndarray  # [C, ROUNDS, BLOCK, 4] of each thread: first slot, end, threads that share a sum, its grid node or -1
    outgoing: np.ndarray  # [C, ROUNDS, BLOCK, 3] of each thread: grid node to send or -1, block that gets it, place in its inbox
    addends: np.ndarray  # [C, K, G] places in the inbox of the K totals that add up to each grid node
    received: np.ndarray  # [C] fours that other blocks send


def by_preference(environments: int, multiprocessors: int) -> list[int]:
    """Numbers of blocks that an environment may have, the best first.

    A step of one ends soonest with many blocks. Many environments take the most steps with few: less is sent, and with one lane for each
    node nothing is computed twice. A cluster lies within a group of multiprocessors, so that clusters at a time fill half of a GPU or more.
    """
    at_once = [blocks for blocks in CLUSTERS if 2 * environments * blocks <= multiprocessors]
    return at_once + sorted(set(CLUSTERS) - set(at_once))


def divide(rest_cells: np.ndarray, corners: np.ndarray, blocks: int) -> Division | None:
    """Divide nodes at [M, 3] (cells), each with the numbers of its grid nodes [M, 27], among so many blocks; None if they are too many."""
    pieces = _bisect(rest_cells, np.arange(len(rest_cells)), blocks)
    largest = max(len(piece) for piece in pieces)
    lanes = next((lanes for lanes in (4, 2, 1) if lanes * largest <= BLOCK), 0)
    if not lanes:
        return None
    # A stencil's grid nodes lie in banks that follow each other, so that lanes of a node, which have neighbours, do not collide.
    begins = np.floor(rest_cells - 0.5).astype(int) @ [9, 3, 1] % BANKS
    bank = np.zeros(corners.max() + 1, int)
    bank[corners] = (begins[:, None] + np.arange(27)) % BANKS
    pieces = [piece[_spread(begins[piece], lanes)] for piece in pieces]
    patches = [_by_bank(np.unique(corners[piece]), bank) for piece in pieces]
    size = max(len(patch) for patch in patches)
    if size > ROUNDS * BLOCK:
        return None
    nodes = np.full((blocks, largest), -1, np.int32)
    local, slot_of = np.zeros((2, blocks, largest, 27), np.int32)
    sums = np.zeros((blocks, ROUNDS, BLOCK, 4), np.int32)
    slots = 0
    for i, (piece, patch) in enumerate(zip(pieces, patches)):
        nodes[i, : len(piece)] = piece
        index = np.argsort(patch)
        local[i, : len(piece)] = index[np.searchsorted(patch, corners[piece], sorter=index)]
        # Fewer and longer sums take less time, more and shorter ones less memory, which many nodes need.
        slot, sums[i], end = _sliced(local[i, : len(piece)].ravel(), len(patch), ROUNDS if lanes == 1 else ROUNDS // 2)
        slot_of[i, : len(piece)] = slot.reshape(-1, 27)
        slots = max(slots, end + 1)

    # All pairs of a grid node of a patch (mine) and the same one of any patch (theirs); those of one grid node follow each other,
    # by block, so that all blocks add up in the same order. With the patch [7, 9] of block 0 and [9] of block 1:
    #   numbers 7 9 9, owner 0 0 1, index 0 1 0;  pairs: mine 0 1 1 2 2, theirs 0 1 2 1 2, rank 0 0 1 0 1;
    #   place 0 1 2 2 0: the own totals lie at 0 and 1 (block 0) and at 0 (block 1), what the other block sends at size = 2;
    #   addends of grid node 9: places 1, 2 in block 0 and 2, 0 in block 1, both block 0's total first.
    owner, index = np.repeat(np.arange(blocks), [len(patch) for patch in patches]), np.concatenate([np.arange(len(p)) for p in patches])
    numbers = np.concatenate(patches)
    order = np.flatnonzero(numbers >= 0)
    order = order[np.argsort(numbers[order], kind="stable")]
    owner, index, numbers = owner[order], index[order], numbers[order]
    first, end = np.searchsorted(numbers, numbers), np.searchsorted(numbers, numbers, "right")
    mine = np.repeat(np.arange(len(numbers)), end - first)
    rank = np.arange(len(mine)) - np.repeat(np.cumsum(end - first) - (end - first), end - first)
    theirs = first[mine] + rank
    # What a block gets from another lies together, and is sent together.
    place = index[theirs]  # of the own totals
    foreign = np.flatnonzero(owner[mine] != owner[theirs])
    foreign = foreign[np.lexsort((numbers[mine[foreign]], owner[theirs[foreign]], owner[mine[foreign]]))]
    received = np.bincount(owner[mine[foreign]], minlength=blocks)
    place[foreign] = size + np.arange(len(foreign)) - np.repeat(np.cumsum(received) - received, received)
    inbox = size + int(received.max()) + 1
    sent = np.bincount(owner[theirs[foreign]], minlength=blocks)
    if sent.max() > ROUNDS * BLOCK or slots + 2 * inbox + size + 1 > SHARED:
        return None
    addends = np.full((blocks, max(AT_ONCE, rank.max() + 1), size), inbox - 1, np.int32)
    addends[owner[mine], rank, index[mine]] = place
    source, target = owner[theirs[foreign]], owner[mine[foreign]]
    foreign = foreign[np.lexsort((place[foreign], (target - source) % blocks, source))]  # not all to the same block at first
    outgoing = np.full((blocks, ROUNDS * BLOCK, 3), -1, np.int32)
    number = np.arange(len(foreign)) - np.repeat(np.cumsum(sent) - sent, sent)
    outgoing[owner[theirs[foreign]], number] = np.stack([index[theirs[foreign]], owner[mine[foreign]], place[foreign]], 1)
    return Division(lanes, slots, inbox, nodes, local, slot_of, sums, outgoing.reshape(blocks, ROUNDS, BLOCK, 3), addends, received)


def _sliced(rows: np.ndarray, size: int, rounds: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Slots [E] for entries of rows [E], the threads' sums [ROUNDS, BLOCK, 4] as in `Division`, of which the first rounds are
    used if they suffice, and the number of slots.

    One, two or four threads of a warp share a row, so that all have about as many entries; entry k of a warp's threads lies
    together, and a row in its own bank.
    """
    lengths = np.bincount(rows, minlength=size)
    slice_of, lane_of = np.zeros((2, size), int)
    longest, count = max(len(rows) // (rounds * BLOCK), 1), ROUNDS * BLOCK
    while count > rounds * BLOCK // WARP:
        sharing = np.minimum(4, 2 ** np.ceil(np.log2(np.maximum(lengths / longest, 1))).astype(int))
        count = 0
        for n in (4, 2, 1):
            group = np.flatnonzero((sharing == n) & (lengths > 0))
            group = group[np.lexsort((-lengths[group], group % BANKS))]
            rank = np.arange(len(group)) - np.searchsorted(group % BANKS, group % BANKS)  # among the rows of its bank
            slice_of[group], lane_of[group] = count + rank * n // 4, group % BANKS + BANKS * n * (rank % (4 // n))
            count += -(-(rank.max(initial=-1) + 1) * n // 4)
        if sharing.max() == 1:
            rounds = ROUNDS  # which hold any patch
        longest += 1 + longest // 8
    depth = np.zeros(count, int)
    np.maximum.at(depth, slice_of, -(-lengths // (2 * sharing)) * 2)  # two at once
    ends = WARP * np.cumsum([0, *depth])
    order = np.argsort(rows, kind="stable")
    entry = np.empty(len(rows), int)  # number within its row
    entry[order] = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    shared = sharing[rows]
    slots = ends[slice_of[rows]] + WARP * (entry // shared) + lane_of[rows] + BANKS * (entry % shared)

    # The longest sums first, each to the warp that has least to do.
    sums, load, row = np.zeros((ROUNDS * BLOCK // WARP, WARP, 4), np.int32), np.zeros(BLOCK // WARP), np.empty(count, int)
    sums[..., 2], sums[..., 3] = 1, -1
    used = np.zeros(BLOCK // WARP, int)
    for number in np.argsort(-depth, kind="stable"):
        warp = np.where(used < ROUNDS, load, np.inf).argmin()
        row[number] = used[warp] * len(used) + warp
        load[warp] += depth[number]
        used[warp] += 1
    sums[row, :, 0], sums[row, :, 1] = ends[:-1, None] + np.arange(WARP), ends[1:, None]
    summed = np.flatnonzero(lengths)
    sums[row[slice_of[summed]], :, 2] = sharing[summed, None]
    sums[row[slice_of[summed]], lane_of[summed], 3] = summed
    return slots, sums.reshape(ROUNDS, BLOCK, 4), int(ends[-1])


def _by_bank(numbers: np.ndarray, bank: np.ndarray) -> np.ndarray:
    """Numbers of grid nodes in an order in which each lies in its bank, and -1 in between."""
    columns = [numbers[bank[numbers] == column] for column in range(BANKS)]
    table = np.full((max(map(len, columns)), BANKS), -1)
    for column, members in enumerate(columns):
        table[: len(members), column] = members
    return table.ravel()


def _spread(banks: np.ndarray, lanes: int) -> np.ndarray:
    """An order of nodes with stencils that begin in these banks [P], in which those whose lanes load at once load from others."""
    queues = [list(np.flatnonzero(banks == bank)) for bank in range(BANKS)]
    order: list[int] = []
    while len(order) < len(banks):
        lengths = np.array([len(queue) for queue in queues])
        first = lengths.reshape(-1, lanes).sum(0).argmax()  # of banks that follow each other at this distance
        for bank in range(first, BANKS, lanes):
            queue = queues[bank] or max(queues, key=len)
            if queue:
                order.append(int(queue.pop()))
    return np.array(order, int)


def _bisect(points: np.ndarray, members: np.ndarray, count: int) -> list[np.ndarray]:
    """Divide points [M, 3] into compact sets of nearly the same size, a power of two of them."""
    if count == 1:
        return [np.sort(members)]
    along = np.ptp(points[members], axis=0).argmax() if len(members) else 0
    members = members[np.argsort(points[members, along], kind="stable")]
    half = (len(members) + 1) // 2
    return _bisect(points, members[:half], count // 2) + _bisect(points, members[half:], count // 2)
