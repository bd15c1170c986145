"""Plays battles over the endpoint by PySC2, the published Python client, unmodified, with the requests that SMAC makes.

SC2PATH is a folder whose game is `rit starcraft-endpoint`; arguments: episodes, then names of maps. A map of SMAC's own
brings its armies along; of any other, units are created, as REFIL and the authors do. Prints a line an episode.
"""

import math
import random
import sys

from absl import flags
from pysc2 import maps, run_configs
from pysc2.maps import lib
from s2clientprotocol import common_pb2, debug_pb2, raw_pb2, sc2api_pb2

STOP, MOVE, ATTACK, HEAL = 4, 16, 23, 386
REACH, STEP, LIMIT = 6, 8, 200
MIDDLE = 16


class SmacMap(lib.Map):
    directory = "SMAC_Maps"
    players = 2


def launch(name):
    """A game that was joined."""
    if name not in maps.get_maps():
        type(name, (SmacMap,), {"filename": name})
    config = run_configs.get()
    process = config.start(want_rgb=False)
    path = maps.get(name).path
    local = sc2api_pb2.LocalMap(map_path=path, map_data=config.map_data(path))
    create = sc2api_pb2.RequestCreateGame(local_map=local, realtime=False, random_seed=3)
    create.player_setup.add(type=sc2api_pb2.Participant)
    create.player_setup.add(type=sc2api_pb2.Computer, race=common_pb2.Terran, difficulty=sc2api_pb2.VeryHard)
    process.controller.create_game(create)
    options = sc2api_pb2.InterfaceOptions(raw=True, score=False)
    process.controller.join_game(sc2api_pb2.RequestJoinGame(race=common_pb2.Terran, options=options))
    info = process.controller.game_info().start_raw
    assert (info.map_size.x, info.map_size.y) == (32, 32)
    assert (info.playable_area.p1.x, info.playable_area.p1.y) == (32, 32)
    assert len(info.pathing_grid.data) == 128 and len(info.terrain_height.data) == 1024
    return process


def units(controller):
    found = controller.observe().observation.raw_data.units
    return [u for u in found if u.owner == 1], [u for u in found if u.owner == 2]


def kill(controller):
    tags = [unit.tag for side in units(controller) for unit in side]
    if tags:
        controller.debug([debug_pb2.DebugCommand(kill_unit=debug_pb2.DebugKillUnit(tag=tags))])
    controller.step(2)


def command(unit_tags, ability, **target):
    order = raw_pb2.ActionRawUnitCommand(ability_id=ability, unit_tags=unit_tags, queue_command=False, **target)
    return sc2api_pb2.Action(action_raw=raw_pb2.ActionRaw(unit_command=order))


def create(controller, first_type):
    """Three marines of the map's type against three of the game's, by debug commands, sent at each other."""
    for unit_type, owner, x in [(first_type + 4, 1, 9.0), (48, 2, 23.0)]:
        pos = common_pb2.Point2D(x=x, y=MIDDLE)
        made = debug_pb2.DebugCreateUnit(unit_type=unit_type, owner=owner, pos=pos, quantity=3)
        controller.debug([debug_pb2.DebugCommand(create_unit=made)])
    controller.step(2)
    # Every episode, as other people's clients do: the endpoint is told that it sticks.
    controller.debug([debug_pb2.DebugCommand(game_state=debug_pb2.control_enemy)])
    controller.step(4)
    enemies = [unit.tag for unit in units(controller)[1]]
    target = common_pb2.Point2D(x=9.0, y=MIDDLE)
    sent = controller.actions(sc2api_pb2.RequestAction(actions=[command(enemies, ATTACK, target_world_space_pos=target)]))
    assert list(sent.result) == [1], sent


def decide(unit, allies, enemies, rng):
    """Attack whom the unit reaches, or heal who is hurt, mostly; else walk, or stop."""
    # Medivacs alone fly: all units can hit the others.
    hurt = [a for a in allies if not a.is_flying and a.health < a.health_max]
    others, ability = (hurt, HEAL) if unit.is_flying else ([e for e in enemies if not e.is_flying], ATTACK)
    near = [o for o in others if math.hypot(o.pos.x - unit.pos.x, o.pos.y - unit.pos.y) <= REACH]
    if near and rng.random() < 0.9:
        return command([unit.tag], ability, target_unit_tag=rng.choice(near).tag)
    x, y = rng.choice([(2, 0), (-2, 0), (0, 2), (0, -2), (0, 0)])
    if (x, y) == (0, 0):
        return command([unit.tag], STOP)
    to = common_pb2.Point2D(x=unit.pos.x + x, y=unit.pos.y + y)
    return command([unit.tag], MOVE, target_world_space_pos=to)


def play(controller, rng):
    allies, enemies = units(controller)
    counts = len(allies), len(enemies)
    assert all(counts), counts
    for steps in range(1, LIMIT + 1):
        orders = [decide(unit, allies, enemies, rng) for unit in allies]
        results = controller.actions(sc2api_pb2.RequestAction(actions=orders)).result
        assert len(results) == len(orders) and set(results) == {1}, results
        controller.step(STEP)
        allies, enemies = units(controller)
        if not allies or not enemies:
            break
    outcome = "won" if allies and not enemies else "lost" if enemies and not allies else "undecided"
    return f"{counts[0]} against {counts[1]}: {outcome} after {steps} steps"


def main():
    flags.FLAGS(sys.argv[:1])
    episodes, names = int(sys.argv[1]), sys.argv[2:]
    rng = random.Random(1)
    for name in names:
        with launch(name) as controller:
            own_types = {"empty_passive": 1935, "full_map_template": 1970}.get(name)
            for _ in range(episodes):
                kill(controller)
                if own_types is not None:
                    create(controller, own_types)
                while not all(units(controller)):
                    controller.step(1)
                print(name, play(controller, rng), flush=True)
            assert controller.save_replay()


main()
