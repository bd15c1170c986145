//! Worked by hand from v ← 0.75 v + 0.1 F, p ← p + 0.1 v and F = 100 · softplus((touching − distance) / 0.001)
//! · 0.001. More than a few margins inside, softplus is its argument: the force is 100 · (touching − distance).

use super::*;
use rit_episode::{RunSeed, Stream};

/// A movable colliding body like the agents of cooperative navigation: it touches another at 0.3.
const DISC: Body =
    Body { collides: true, movable: true, acceleration: 5.0, ..Body::new(BodyKind::Agent, 0.15) };

/// Resting bodies at these places, all of them agents.
fn world(bodies: &[Body], places: &[Vector]) -> World {
    let mut world = World::new(bodies.to_vec(), bodies.len(), EnvironmentOptions::default());
    world.place(places);
    world
}

/// Takes a joint action and checks every body's position and velocity.
fn step_to(world: &mut World, actions: &[Action], expected: &[(Vector, Vector)]) {
    world.set_forces(actions);
    world.advance();
    for (entity, (body, &(position, velocity))) in world.bodies.iter().zip(expected).enumerate() {
        let error = squared_distance(body.position, position).max(squared_distance(body.velocity, velocity));
        assert!(error.sqrt() < 1e-6, "{entity}: {body:?}");
    }
}

#[test]
fn a_free_body_gains_a_tenth_of_its_force_and_loses_a_quarter_of_its_speed() {
    let mut world = world(&[DISC], &[[0.0, 0.0]]);
    // +x: v = 0.1 · 5, p = 0.1 · 0.5: the new velocity moves it, not the old one.
    step_to(&mut world, &[2], &[([0.05, 0.0], [0.5, 0.0])]);
    // Nothing: v = 0.75 · 0.5.
    step_to(&mut world, &[0], &[([0.0875, 0.0], [0.375, 0.0])]);
    // −y, +y, −x. v_x: 0.28125, 0.2109375, 0.158203125 − 0.5; v_y: −0.5, −0.375 + 0.5, 0.09375.
    step_to(&mut world, &[3], &[([0.115_625, -0.05], [0.281_25, -0.5])]);
    step_to(&mut world, &[4], &[([0.136_718_75, -0.0375], [0.210_937_5, 0.125])]);
    let last = ([0.102_539_06, -0.028_125], [-0.341_796_88, 0.093_75]);
    step_to(&mut world, &[1], &[last]);
}

#[test]
fn in_mpe2_the_old_velocity_moves_a_body() {
    let mut world = world(&[DISC], &[[0.0, 0.0]]);
    world.physics = Physics::Mpe2;
    // +x: p = 0, v = 0.1 · 5. Nothing: p = 0.1 · 0.5, v = 0.75 · 0.5. −y: p = 0.05 + 0.0375, v = (0.28125, −0.5).
    step_to(&mut world, &[2], &[([0.0, 0.0], [0.5, 0.0])]);
    step_to(&mut world, &[0], &[([0.05, 0.0], [0.375, 0.0])]);
    step_to(&mut world, &[3], &[([0.0875, 0.0], [0.281_25, -0.5])]);
}

#[test]
fn speed_is_capped_and_keeps_its_direction() {
    let capped = Body { acceleration: 3.0, speed_max: 1.0, ..DISC };
    let mut world = world(&[capped], &[[0.0, 0.0]]);
    world.bodies[0].velocity = [1.6, 0.0];
    // +y: (1.2, 0.3) has length √1.53 = 1.2369317; divided by it (0.9701425, 0.2425356).
    step_to(&mut world, &[4], &[([0.097_014_25, 0.024_253_56], [0.970_142_5, 0.242_535_6])]);
    // +x from rest: 0.3, 0.525, 0.69375, 0.8203125, 0.9152344, 0.9864258, then 1.0398194 is capped to 1.
    world.place(&[[0.0, 0.0]]);
    let mut x = 0.0;
    for speed in [0.3, 0.525, 0.693_75, 0.820_312_5, 0.915_234_4, 0.986_425_8, 1.0, 1.0] {
        x += 0.1 * speed;
        step_to(&mut world, &[2], &[([x, 0.0], [speed, 0.0])]);
    }
}

#[test]
fn overlapping_bodies_push_each_other_apart() {
    // Distance 0.2 of 0.3: F = 100 · 0.1 = 10 each way, v = ±1, p = ±(0.1 + 0.1). Then they are 0.4 apart, too
    // far to touch, and coast: 0.75, 0.5625.
    let mut pair = world(&[DISC; 2], &[[0.1, 0.0], [-0.1, 0.0]]);
    step_to(&mut pair, &[0, 0], &[([0.2, 0.0], [1.0, 0.0]), ([-0.2, 0.0], [-1.0, 0.0])]);
    step_to(&mut pair, &[0, 0], &[([0.275, 0.0], [0.75, 0.0]), ([-0.275, 0.0], [-0.75, 0.0])]);
    step_to(&mut pair, &[0, 0], &[([0.331_25, 0.0], [0.5625, 0.0]), ([-0.331_25, 0.0], [-0.5625, 0.0])]);

    // Along a 3-4-5 diagonal: 10 · (0.6, 0.8). The first also accelerates by +x: (−6 + 5, −8).
    let mut pair = world(&[DISC; 2], &[[0.0, 0.0], [0.12, 0.16]]);
    step_to(&mut pair, &[2, 0], &[([-0.01, -0.08], [-0.1, -0.8]), ([0.18, 0.24], [0.6, 0.8])]);

    // Three in a row, 0.2 apart: what the middle one feels cancels; the outer two are 0.4 apart, too far.
    let mut row = world(&[DISC; 3], &[[-0.2, 0.0], [0.0, 0.0], [0.2, 0.0]]);
    step_to(
        &mut row,
        &[0, 0, 0],
        &[([-0.3, 0.0], [-1.0, 0.0]), ([0.0, 0.0], [0.0, 0.0]), ([0.3, 0.0], [1.0, 0.0])],
    );
}

#[test]
fn contact_sets_in_softly() {
    // Just touching: 0.1 · ln 2. One margin apart: 0.1 · ln(1 + 1/e). Two margins inside: 0.1 · ln(1 + e²).
    for (distance, force) in [(0.3, 0.069_314_72), (0.301, 0.031_326_17), (0.298, 0.212_692_8)] {
        let [x, y] = contact_force([0.0, 0.0], [0.0, distance], 0.3).unwrap();
        assert_eq!(x, 0.0);
        // The distance is rounded to 3e-8 of its 0.3: 3e-5 of a margin.
        assert!((y + force).abs() < 1e-4 * force, "{distance}: {y}");
    }
}

#[test]
fn what_is_left_out_for_being_too_far_is_exactly_nothing() {
    let limit = 0.3 + NO_CONTACT_GAP;
    assert_eq!(contact_force([0.0, 0.0], [limit * 0.999_999, 0.0], 0.3), Some([0.0, 0.0]));
    assert_eq!(contact_force([0.0, 0.0], [limit * 1.000_001, 0.0], 0.3), None);
}

#[test]
fn fixed_bodies_push_without_moving_and_others_without_contact_do_neither() {
    let obstacle = Body { collides: true, ..Body::new(BodyKind::Landmark, 0.2) };
    let landmark = Body::new(BodyKind::Landmark, 0.05);
    // 0.3 of 0.35 from the obstacle: F = 5. The landmark lies beneath the disc, the obstacles on each other.
    let mut world =
        world(&[DISC, obstacle, obstacle, landmark], &[[0.0, 0.3], [0.0, 0.0], [0.0, -0.1], [0.0, 0.3]]);
    let still = |place| (place, [0.0, 0.0]);
    step_to(
        &mut world,
        &[0; 4],
        &[([0.0, 0.35], [0.0, 0.5]), still([0.0, 0.0]), still([0.0, -0.1]), still([0.0, 0.3])],
    );
}

#[test]
fn contact_keeps_momentum() {
    let rng = &mut RunSeed(0).stream(Stream::Environment, 0);
    let mut touched = 0;
    for _ in 0..2000 {
        let mut place = || [rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4)];
        let mut pair = world(&[DISC; 2], &[place(), place()]);
        for body in &mut pair.bodies {
            body.velocity = place();
        }
        let before = sum(pair.bodies[0].velocity, pair.bodies[1].velocity);
        pair.set_forces(&[0, 0]);
        pair.advance();
        // The two forces are opposite to the last bit; what damping leaves is 0.75 of the momentum.
        let [one, other] = [pair.bodies[0], pair.bodies[1]];
        assert_eq!(sum(one.force, other.force), [0.0, 0.0]);
        touched += usize::from(one.force != [0.0, 0.0]);
        let after = sum(one.velocity, other.velocity);
        assert!(squared_distance(after, scaled(before, KEPT_VELOCITY)).sqrt() < 1e-6);
    }
    assert!(touched > 500, "the draws meet contact: {touched}");
}

#[test]
fn bodies_at_one_point_part_along_x() {
    // F = 100 · 0.3 = 30: v = ±3, p = ±0.3.
    let mut pair = world(&[DISC; 2], &[[0.0, 0.0]; 2]);
    step_to(&mut pair, &[0, 0], &[([0.3, 0.0], [3.0, 0.0]), ([-0.3, 0.0], [-3.0, 0.0])]);
    // Distances whose squares vanish or lose their digits.
    for offset in [f32::MIN_POSITIVE, 1e-30, 2.6e-23, 3e-23, 1e-20, 1e-10] {
        let mut crowd = world(&[DISC; 3], &[[0.0, 0.0], [0.0, offset], [offset, offset]]);
        for _ in 0..STEPS {
            crowd.set_forces(&[0, 0, 0]);
            crowd.advance();
        }
        for body in &crowd.bodies {
            assert!(body.position.iter().chain(&body.velocity).all(|x| x.is_finite()));
        }
        let [a, b, c] = [0, 1, 2].map(|index| crowd.bodies[index]);
        assert!(!a.overlaps(&b) && !a.overlaps(&c) && !b.overlaps(&c), "{offset}");
    }
}

#[test]
fn reset_scatters_resting_bodies_over_their_squares() {
    let near = Body { start_within: 0.5, ..DISC };
    let mut scattered = world(&[DISC, near], &[[0.0, 0.0]; 2]);
    let mut farthest = [0.0_f32; 2];
    for episode in 0..500 {
        scattered.bodies[0].velocity = [1.0, 1.0];
        scattered.reset(&mut RunSeed(0).stream(Stream::Environment, episode));
        for (farthest, body) in farthest.iter_mut().zip(&scattered.bodies) {
            assert_eq!(body.velocity, [0.0, 0.0]);
            *farthest = farthest.max(body.position[0].abs()).max(body.position[1].abs());
        }
    }
    assert!((0.99..1.0).contains(&farthest[0]), "{farthest:?}");
    assert!((0.49..0.5).contains(&farthest[1]), "{farthest:?}");
}

#[test]
fn the_twenty_fifth_step_is_terminal() {
    let mut world = world(&[DISC], &[[0.0, 0.0]]);
    for episode in 0..2 {
        world.reset(&mut RunSeed(0).stream(Stream::Environment, episode));
        for step in 1..=25 {
            world.set_forces(&[0]);
            let expected = (step == 25).then_some(End::Terminated);
            assert_eq!(world.advance(), expected, "{step}");
        }
    }
}

/// Three bodies in a row, 0.5 and 0.25 apart: two agents and a landmark.
fn row(view_radius: Option<f32>) -> Observation {
    let bodies = vec![DISC, DISC, Body::new(BodyKind::Landmark, 0.05)];
    let mut world =
        World::new(bodies, 2, EnvironmentOptions { view_radius, ..EnvironmentOptions::default() });
    world.place(&[[0.0, 0.25], [0.5, 0.25], [0.75, 0.25]]);
    world.bodies[1].velocity = [-1.0, 2.0];
    let mut observation = Observation::new(2, 3, FEATURES, DIRECTIONS.len());
    world.observe(&mut observation);
    observation
}

#[test]
fn features_are_position_velocity_and_kind() {
    let seen = row(None);
    assert_eq!(
        seen.entities(),
        [
            [0.0, 0.25, 0.0, 0.0, 1.0, 0.0, 0.0],
            [0.5, 0.25, -1.0, 2.0, 1.0, 0.0, 0.0],
            [0.75, 0.25, 0.0, 0.0, 0.0, 1.0, 0.0],
        ]
        .concat()
    );
    assert_eq!(seen.observable(), [1; 6]);
    assert_eq!(seen.available(), [1; 10]);
}

#[test]
fn a_view_radius_hides_what_is_farther_and_nothing_else() {
    let everything = row(None);
    for (radius, expected) in [
        (0.0, [[1, 0, 0], [0, 1, 0]]),
        (0.25, [[1, 0, 0], [0, 1, 1]]),
        (0.499, [[1, 0, 0], [0, 1, 1]]),
        // Exactly at the radius is within it.
        (0.5, [[1, 1, 0], [1, 1, 1]]),
        (0.75, [[1, 1, 1], [1, 1, 1]]),
    ] {
        let seen = row(Some(radius));
        assert_eq!(seen.observable(), expected.concat(), "{radius}");
        assert_eq!(seen.entities(), everything.entities(), "the state itself stays whole");
        assert_eq!(seen.available(), everything.available());
    }
}

#[test]
#[should_panic(expected = "a view radius is not negative")]
fn a_view_radius_that_is_not_a_number_is_refused() {
    let _ = row(Some(f32::NAN));
}

#[test]
fn softplus_is_the_same_to_the_bit_on_every_machine() {
    // A change here would change what every saved seed means.
    let pinned = [
        (-3.0, 0x3d47_0388),
        (-0.5, 0x3ef2_ba38),
        (0.0, 0x3f31_7218),
        (0.7, 0x3f8d_3533),
        (9.0, 0x4110_0081),
    ];
    assert_eq!(pinned.map(|(x, _)| (x, softplus(x).to_bits())), pinned);
    for (x, _) in pinned {
        let real = f64::from(x).exp().ln_1p();
        assert!((f64::from(softplus(x)) - real).abs() <= 2e-7 * real, "{x}");
    }
}
