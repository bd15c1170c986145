use super::PredatorPreyReward::{Plain, Pro};
use super::*;
use rit_episode::{RunSeed, Stream};

/// Out of everyone's way.
const OBSTACLES_AT: [Vector; 2] = [[50.0, 50.0], [-50.0, -50.0]];

fn placed(predators: &[Vector], prey: &[Vector], reward: PredatorPreyReward) -> PredatorPrey {
    let mut environment =
        PredatorPrey::new(predators.len(), prey.len(), reward, EnvironmentOptions::default());
    environment.world.place(&[predators, &OBSTACLES_AT, prey].concat());
    environment
}

fn predators_at(places: &[Vector]) -> Vec<Body> {
    let at = |&position| Body { position, ..PREDATOR };
    places.iter().map(at).collect()
}

fn stream(episode: u64) -> Rng {
    RunSeed(0).stream(Stream::Environment, episode)
}

#[test]
fn pays_catches_and_in_the_pro_series_distance() {
    // Predator and prey touch at 0.125. Pro: −0.1 · m · Σ_predators distance to the nearest prey.
    let table: [(&[Vector], &[Vector], f32, f32); 7] = [
        // m = 2 at distances 1 and 3: −0.1 · 2 · 4.
        (&[[1.0, 0.0], [0.0, 3.0]], &[[0.0, 0.0]], 0.0, -0.8),
        // One of them overlaps: a catch, but not a pro one. −0.2 · (0.1 + 3).
        (&[[0.1, 0.0], [0.0, 3.0]], &[[0.0, 0.0]], 10.0, -0.62),
        // Both overlap: −0.2 · 0.2.
        (&[[0.1, 0.0], [0.0, 0.1]], &[[0.0, 0.0]], 10.0, 10.0 - 0.04),
        // Touching is no overlap.
        (&[[0.125, 0.0], [0.0, 0.125]], &[[0.0, 0.0]], 0.0, -0.05),
        // Each overlaps a prey of its own: that is one catch, and not a pro one.
        (&[[0.1, 0.0], [2.1, 0.0]], &[[0.0, 0.0], [2.0, 0.0]], 10.0, -0.04),
        // m = 3; the prey nearest to each: 0.5, 0.5, 1: −0.3 · 2.
        (&[[0.5, 0.0], [1.5, 0.0], [2.0, 1.0]], &[[0.0, 0.0], [2.0, 0.0]], 0.0, -0.6),
        // Two prey, each caught by two at once, still pay once: −0.4 · 0.4.
        (&[[0.1, 0.0], [-0.1, 0.0], [2.1, 0.0], [1.9, 0.0]], &[[0.0, 0.0], [2.0, 0.0]], 10.0, 10.0 - 0.16),
    ];
    for (predators, prey, plain, pro) in table {
        for (series, expected) in [(Plain, plain), (Pro, pro)] {
            let reward = placed(predators, prey, series).team_reward();
            let what = format!("{series:?} {predators:?} {prey:?}: {reward}");
            assert!((reward - expected).abs() < 1e-5, "{what}");
        }
    }
}

#[test]
fn shaping_pays_what_a_step_takes_off_the_distances_and_touches_no_reward() {
    let (predators, prey) = ([[-3.0, 0.0], [0.0, 4.0]], [[0.0, 0.0]]);
    let steps = [0.0, 2.0].map(|approach_shaping| {
        let options = EnvironmentOptions { approach_shaping, ..EnvironmentOptions::default() };
        let mut environment = PredatorPrey::new(2, 1, Pro, options);
        environment.world.place(&[&predators[..], &OBSTACLES_AT, &prey].concat());
        // The first goes right, towards the prey; the second stays.
        let step = environment.step(&[2, 0], &mut stream(7)).unwrap();
        (step, environment.prey()[0].position)
    });
    let [(plain, at), (shaped, _)] = steps;
    // Velocity first, then position: 0.1 · 3, and a tenth of that.
    let distances = (-2.97 - at[0]).hypot(at[1]) + at[0].hypot(4.0 - at[1]);
    assert!((shaped.shaping - 2.0 * (7.0 - distances)).abs() < 1e-5, "{shaped:?}");
    assert!((plain.reward + 0.2 * distances).abs() < 1e-5, "{plain:?}");
    assert_eq!(plain, Step { shaping: 0.0, ..shaped });
}

#[test]
fn prey_flee_to_the_free_candidate_farthest_from_the_nearest_predator() {
    // The same rule by the book: all candidates, then those that are free, then the farthest.
    for episode in 0..200 {
        let mut place = {
            let mut rng = stream(1000 + episode);
            move || [rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)]
        };
        let predators = predators_at(&[place(), place(), place()]);
        let prey = place();
        let distance = |a: Vector, b: Vector| (a[0] - b[0]).hypot(a[1] - b[1]);
        let nearest = predators
            .iter()
            .min_by(|a, b| distance(prey, a.position).total_cmp(&distance(prey, b.position)))
            .unwrap();
        let mut rng = stream(episode);
        let mut offsets: Vec<Vector> = (0..100).map(|_| point_of_unit_disk(&mut rng)).collect();
        offsets.retain(|&offset| {
            predators.iter().all(|predator| distance(sum(prey, offset), predator.position) >= 0.125)
        });
        let from_nearest = |offset: Vector| distance(sum(prey, offset), nearest.position);
        let farthest = offsets.iter().copied().max_by(|&a, &b| from_nearest(a).total_cmp(&from_nearest(b)));
        assert_eq!(Some(flight(prey, &predators, &mut stream(episode))), farthest);
    }
}

#[test]
fn prey_avoid_places_at_which_they_would_overlap_a_predator() {
    // The first predator drives the prey towards (1, 0), where the second waits.
    let (alone, guarded) = (predators_at(&[[-0.2, 0.0]]), predators_at(&[[-0.2, 0.0], [1.0, 0.0]]));
    let caught = |offset: Vector| squared_distance(offset, [1.0, 0.0]) < 0.125 * 0.125;
    let mut would_be_caught = 0;
    for episode in 0..500 {
        would_be_caught += usize::from(caught(flight([0.0, 0.0], &alone, &mut stream(episode))));
        assert!(!caught(flight([0.0, 0.0], &guarded, &mut stream(episode))));
    }
    assert!(would_be_caught > 50, "{would_be_caught}");
}

#[test]
fn prey_without_a_free_candidate_stay() {
    // Predators on a grid of 0.15 leave no free place: the farthest one can be from all is 0.107 < 0.125.
    let grid: Vec<Vector> = (0..17 * 17)
        .map(|index| [(index % 17) as f32 * 0.15 - 1.2, (index / 17) as f32 * 0.15 - 1.2])
        .collect();
    assert_eq!(flight([0.01, 0.02], &predators_at(&grid), &mut stream(0)), [0.0, 0.0]);
}

#[test]
fn the_offset_is_the_prey_s_force_and_its_draws_are_pinned() {
    // Two prey at rest, out of reach of everything: v = 0.1 · 4 · offset, p = p + 0.1 v. Both decide before
    // either moves, in their order, from the same stream.
    let prey = [[0.0, 0.0], [9.0, 0.0]];
    let mut environment = placed(&[[-3.0, 0.0], [5.0, 0.0]], &prey, Plain);
    environment.step(&[0, 0], &mut stream(3)).unwrap();

    let mut rng = stream(3);
    let predators = predators_at(&[[-3.0, 0.0], [5.0, 0.0]]);
    for (body, from) in environment.prey().iter().zip(prey) {
        let offset = flight(from, &predators, &mut rng);
        assert!(squared_distance(body.velocity, scaled(offset, 0.4)).sqrt() < 1e-6);
        assert!(squared_distance(body.position, sum(from, scaled(offset, 0.04))).sqrt() < 1e-6);
        // Away from the predator, and with nearly all of its strength: the best of a hundred.
        assert!(offset[0] > 0.8, "{offset:?}");
    }
    // A change here would change what every saved seed means.
    assert_eq!(flight([0.0, 0.0], &predators, &mut stream(3)), [0.960_254_2, -0.108_367_44]);
}

#[test]
fn candidates_are_uniform_over_the_unit_disk() {
    let mut rng = stream(0);
    let (mut length, mut squared, mut mean) = (0.0, 0.0, [0.0; 2]);
    for _ in 0..20_000 {
        let point = point_of_unit_disk(&mut rng);
        squared += squared_distance(point, [0.0; 2]) / 20_000.0;
        length += squared_distance(point, [0.0; 2]).sqrt() / 20_000.0;
        mean = sum(mean, scaled(point, 1.0 / 20_000.0));
    }
    // E √U = 2/3 and E U = 1/2, with standard errors 0.0017 and 0.0020; each mean 0 with 0.0035.
    assert!((length - 2.0 / 3.0).abs() < 0.007, "{length}");
    assert!((squared - 0.5).abs() < 0.008, "{squared}");
    assert!(mean[0].abs() < 0.014 && mean[1].abs() < 0.014, "{mean:?}");
}

#[test]
fn the_scene_shows_predators_obstacles_and_prey() {
    let scene = placed(&[[0.0, 0.5]], &[[1.0, 0.0]], Pro).scene().unwrap();
    let bodies: Vec<_> = scene.bodies.iter().map(|body| (body.kind, body.radius)).collect();
    assert_eq!(
        bodies,
        [
            (BodyKind::Agent, 0.075),
            (BodyKind::Landmark, 0.2),
            (BodyKind::Landmark, 0.2),
            (BodyKind::Prey, 0.05)
        ]
    );
    assert_eq!([scene.bodies[3].x, scene.bodies[3].y], [1.0, 0.0]);
}

#[test]
fn predators_and_prey_are_as_fast_as_they_should_be() {
    // The predator drives right and the prey flees to the right before it. v = 0.75 v + 0.3 would go to 1.2,
    // v = 0.75 v + 0.4 · offset to more than 1.3.
    let mut environment = placed(&[[-3.0, 0.0]], &[[0.0, 0.0]], Plain);
    let mut rng = stream(0);
    let speeds: Vec<[f32; 2]> = (0..20)
        .map(|_| {
            environment.step(&[2], &mut rng).unwrap();
            [environment.predators()[0].velocity, environment.prey()[0].velocity].map(|v| v[0].hypot(v[1]))
        })
        .collect();
    assert!((speeds[0][0] - 0.3).abs() < 1e-6, "{speeds:?}");
    for (speed, limit) in speeds[19].into_iter().zip([1.0, 1.3]) {
        assert!((speed - limit).abs() < 1e-6, "{speeds:?}");
    }
}

#[test]
fn everyone_begins_in_a_square_and_obstacles_in_a_smaller_one() {
    let mut environment = PredatorPrey::new(3, 2, Plain, EnvironmentOptions::default());
    let mut farthest = [0.0_f32; 7];
    for episode in 0..500 {
        environment.reset(&mut stream(episode)).unwrap();
        for (farthest, body) in farthest.iter_mut().zip(&environment.world.bodies) {
            *farthest = body.position.iter().fold(*farthest, |most, x| most.max(x.abs()));
        }
    }
    for (body, farthest) in farthest.into_iter().enumerate() {
        let half = if (3..5).contains(&body) { 0.9 } else { 1.0 };
        assert!(farthest <= half && farthest > half - 0.01, "body {body}: {farthest}");
    }
}

#[test]
fn all_push_one_another_and_obstacles_stay() {
    // Pairs that overlap by 0.01, so the force is 1 and a step moves 0.01: predator and obstacle, predator and prey,
    // obstacle and prey, prey and prey.
    let mut environment = PredatorPrey::new(2, 4, Plain, EnvironmentOptions::default());
    let places = [
        [[0.0, 0.0], [0.0, 10.0]].as_slice(),
        &[[0.265, 0.0], [0.0, 20.0]],
        &[[0.115, 10.0], [0.24, 20.0], [0.0, 30.0], [0.09, 30.0]],
    ]
    .concat();
    environment.world.place(&places);
    // Without the prey's rule.
    environment.world.set_forces(&[0, 0]);
    environment.world.advance();
    let pushes = [-0.01, -0.01, 0.0, 0.0, 0.01, 0.01, -0.01, 0.01];
    for (entity, (body, (from, push))) in
        environment.world.bodies.iter().zip(places.iter().zip(pushes)).enumerate()
    {
        let moved = [body.position[0] - from[0], body.position[1] - from[1]];
        assert!((moved[0] - push).abs() < 1e-5 && moved[1] == 0.0, "{entity}: {moved:?}");
    }
}
