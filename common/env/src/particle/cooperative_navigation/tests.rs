use super::*;
use rit_episode::{RunSeed, Stream};

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
