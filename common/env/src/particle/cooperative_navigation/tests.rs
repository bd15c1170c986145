use super::*;
use rit_episode::{End, RunSeed, Stream};
use serde::Deserialize;

/// The task (2, 2) with its agents and landmarks at these places.
fn placed(places: [[f32; 2]; 4]) -> CooperativeNavigation {
    let mut environment = CooperativeNavigation::new(2, EnvironmentOptions::default());
    environment.world.place(&places);
    environment
}

#[test]
fn pays_distances_and_overlaps_to_every_agent() {
    let table = [
        // Both landmarks covered, apart: each agent pays for overlapping itself.
        ([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [1.0, 0.0]], -2.0),
        // Nearest distances 0.5 and 0.25, whichever agent is near: −2 · 0.75 − 2.
        ([[0.0, 0.0], [1.0, 0.0], [0.0, 0.5], [1.0, -0.25]], -3.5),
        ([[0.0, 0.0], [1.0, 0.0], [1.0, -0.25], [0.0, 0.5]], -3.5),
        // One agent is nearest to both: 3-4-5, 0.5 each: −2 · 1 − 2.
        ([[0.0, 0.0], [5.0, 0.0], [0.3, 0.4], [-0.4, 0.3]], -4.0),
        // 0.2 apart they overlap: each pays for itself and for the other. Distances 0 and 0.8.
        ([[0.0, 0.0], [0.2, 0.0], [0.0, 0.0], [1.0, 0.0]], -1.6 - 4.0),
        // At 0.3 they touch, which is no overlap.
        ([[0.0, 0.0], [0.3, 0.0], [0.0, 0.0], [0.3, 0.0]], -2.0),
    ];
    for (places, expected) in table {
        let reward = placed(places).team_reward();
        assert!((reward - expected).abs() < 1e-6, "{places:?}: {reward}");
    }
}

#[test]
fn pays_for_the_state_that_the_step_leads_to() {
    // Agent 0 moves from 0 to 0.05 on its way to 0.55: 0.5 is missing. Agent 1 covers its landmark.
    let mut environment = placed([[0.0, 0.0], [2.0, 0.0], [0.55, 0.0], [2.0, 0.0]]);
    let step = environment.step(&[2, 0], &mut RunSeed(0).stream(Stream::Environment, 0)).unwrap();
    assert!((step.reward + 2.0 * 0.5 + 2.0).abs() < 1e-6, "{step:?}");
    assert_eq!((step.end, step.won), (None, false));
}

#[test]
fn the_scene_shows_agents_and_landmarks() {
    let scene = placed([[0.0, 0.5], [1.0, 0.0], [0.25, 0.0], [-1.0, 0.0]]).scene().unwrap();
    let bodies: Vec<_> = scene.bodies.iter().map(|body| (body.kind, [body.x, body.y], body.radius)).collect();
    assert_eq!(
        bodies,
        [
            (BodyKind::Agent, [0.0, 0.5], 0.15),
            (BodyKind::Agent, [1.0, 0.0], 0.15),
            (BodyKind::Landmark, [0.25, 0.0], 0.05),
            (BodyKind::Landmark, [-1.0, 0.0], 0.05),
        ]
    );
}

/// An episode of mpe2's simple_spread, as `tests/mpe2/record.py` writes it.
#[derive(Deserialize)]
struct Recorded {
    n: usize,
    start: Vec<[f32; 2]>,
    steps: Vec<RecordedStep>,
}

#[derive(Deserialize)]
struct RecordedStep {
    actions: Vec<Action>,
    positions: Vec<[f32; 2]>,
    velocities: Vec<[f32; 2]>,
    reward: f32,
    terminated: bool,
    truncated: bool,
}

/// mpe2 computes with 64 bits, this world with 32, and contact multiplies the difference: each step begins where mpe2's did.
#[test]
fn mpe2_physics_are_those_of_mpe2() {
    let episodes: Vec<Recorded> =
        serde_json::from_str(include_str!("../../../tests/mpe2/simple_spread.json")).unwrap();
    let rng = &mut RunSeed(0).stream(Stream::Environment, 0);
    let mut collisions = 0;
    for Recorded { n, start, steps } in episodes {
        let options = EnvironmentOptions { physics: Physics::Mpe2, ..EnvironmentOptions::default() };
        let mut environment = CooperativeNavigation::new(n, options);
        environment.world.place(&start);
        assert_eq!(steps.len(), environment.spec().steps_max);
        for (at, expected) in steps.iter().enumerate() {
            let step = environment.step(&expected.actions, rng).unwrap();
            let agents = &mut environment.world.bodies[..n];
            for ((agent, &position), &velocity) in
                agents.iter_mut().zip(&expected.positions).zip(&expected.velocities)
            {
                let near = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs().max((a[1] - b[1]).abs()) < 2e-5;
                let is_there = near(agent.position, position) && near(agent.velocity, velocity);
                assert!(is_there, "{n} agents, step {at}: {agent:?}, not {position:?} and {velocity:?}");
                (agent.position, agent.velocity) = (position, velocity);
            }
            assert!((step.reward - expected.reward).abs() < 1e-4, "{n} agents, step {at}: {}", step.reward);
            let end = match (expected.terminated, expected.truncated) {
                (true, _) => Some(End::Terminated),
                (false, true) => Some(End::Truncated),
                (false, false) => None,
            };
            assert_eq!(step.end, end);
            let touching =
                |index: &usize| agents[..*index].iter().any(|other| other.overlaps(&agents[*index]));
            collisions += (0..n).filter(touching).count();
        }
    }
    assert!(collisions > 10, "the record shows collisions: {collisions}");
}
