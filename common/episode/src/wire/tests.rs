use super::*;
use crate::{EpisodeBuilder, Observation, RunSeed, Stream};
use proptest::prelude::*;

const DIMS: Dims = Dims { entity_dim: 5, n_actions: 3, agents_max: 4, entities_max: 7, steps_max: 6 };
const RUN: RunId = *b"a run's sixteen.";

fn expected() -> Expected {
    let size = |n_agents, n_entities| TaskSize { n_agents, n_entities };
    Expected {
        run_id: RUN,
        layout: PayloadLayout::new(DIMS),
        tasks: vec![size(2, 4), size(4, 7), size(1, 1), size(3, 3)],
    }
}

/// An episode of random content for the task.
fn episode(task: usize, steps: usize, seed: u64) -> Episode {
    let rng = &mut RunSeed(seed).stream(Stream::Environment, 0);
    let TaskSize { n_agents, n_entities } = expected().tasks[task];
    let observe = |rng: &mut crate::Rng| {
        let mut observation = Observation::new(n_agents, n_entities, DIMS.entity_dim, DIMS.n_actions);
        for entity in 0..n_entities {
            observation.entity_mut(entity).iter_mut().for_each(|x| *x = rng.random_range(-2.0..2.0));
        }
        for agent in 0..n_agents {
            observation.observable_mut(agent).iter_mut().for_each(|seen| *seen = rng.random_range(0..=1));
            observation.available_mut(agent).fill(1);
        }
        observation
    };
    let order = decision_order::draw(n_agents, rng);
    let mut builder = EpisodeBuilder::new(seed, seed / 2, task, order, &observe(rng));
    for _ in 0..steps {
        let actions: Vec<u8> = (0..n_agents).map(|_| rng.random_range(0..DIMS.n_actions) as u8).collect();
        let (reward, shaping) = (rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
        builder.step(&actions, reward, shaping, &observe(rng));
    }
    builder
        .finish(if seed.is_multiple_of(2) { End::Terminated } else { End::Truncated }, seed.is_multiple_of(3))
}

fn frame(episode: &Episode) -> Frame {
    let layout = PayloadLayout::new(DIMS);
    let mut frame = Frame::new(&layout);
    encode(episode, &layout, RUN, 7, &mut frame).unwrap();
    frame
}

/// Changes a frame, mends its checksum, and decodes it.
fn altered(change: impl FnOnce(&mut Header, &mut [u8])) -> Result<Episode, Rejection> {
    let mut frame = frame(&episode(0, 6, 1));
    change(&mut frame.header, &mut frame.payload);
    frame.header.checksum = checksum(&frame.header, &frame.payload);
    decode(&frame.header, &frame.payload, &expected())
}

proptest! {
    #[test]
    fn an_episode_survives_the_way(task in 0..4_usize, steps in 1..=6_usize, seed in 0..1000_u64) {
        let sent = episode(task, steps, seed);
        let frame = frame(&sent);
        prop_assert_eq!(decode(&frame.header, &frame.payload, &expected()), Ok(sent));
    }

    #[test]
    fn no_flipped_bit_goes_unnoticed(bit in 0..8 * size_of::<Header>() + 8 * 1000) {
        let mut frame = frame(&episode(1, 6, 3));
        let (byte, mask) = (bit / 8, 1 << (bit % 8));
        let header = bytemuck::bytes_of_mut(&mut frame.header);
        if byte < header.len() {
            header[byte] ^= mask;
        } else {
            frame.payload[byte - header.len()] ^= mask;
        }
        prop_assert!(decode(&frame.header, &frame.payload, &expected()).is_err());
    }

    #[test]
    fn no_bytes_make_it_panic(header: [u8; 32], at in 0..56_usize, payload: Vec<u8>, mend: bool) {
        let mut frame = frame(&episode(1, 6, 3));
        bytemuck::bytes_of_mut(&mut frame.header)[at..at + 32].copy_from_slice(&header);
        let len = payload.len().min(frame.payload.len());
        frame.payload[..len].copy_from_slice(&payload[..len]);
        if mend {
            frame.header.magic = MAGIC;
            frame.header.checksum = checksum(&frame.header, &frame.payload);
        }
        let _ = decode(&frame.header, &frame.payload, &expected());
        let _ = decode(&frame.header, &payload, &expected());
    }
}

#[test]
fn rows_lie_where_the_layout_says() {
    // Two agents of at most four, two other entities: rows 0, 1 and, after the padded agents, 4, 5.
    let sent = episode(0, 1, 2);
    let frame = frame(&sent);
    let feature = |time: usize, row: usize| {
        let at = 4 * DIMS.entity_dim * (time * DIMS.entities_max + row);
        f32::from_le_bytes(frame.payload[at..at + 4].try_into().unwrap())
    };
    let d = DIMS.entity_dim;
    assert_eq!([0, 1, 4, 5].map(|row| feature(0, row)), [0, 1, 2, 3].map(|row| sent.entities[row * d]));
    assert_eq!([0, 1, 4, 5].map(|row| feature(1, row)), [4, 5, 6, 7].map(|row| sent.entities[row * d]));
    assert_eq!([2, 3, 6].map(|row| feature(0, row)), [0.0; 3]);
    assert_eq!(frame.payload.len() % ALIGNMENT, 0);
}

#[test]
fn an_encoder_refuses_what_does_not_fit() {
    let layout = PayloadLayout::new(Dims { steps_max: 2, ..DIMS });
    let refused = encode(&episode(0, 3, 1), &layout, RUN, 0, &mut Frame::new(&layout)).unwrap_err();
    assert_eq!(refused.steps, 3);
}

#[test]
fn each_fault_has_its_name() {
    let layout = PayloadLayout::new(DIMS);
    let reason = |result: Result<Episode, Rejection>| result.map_err(|rejection| rejection.reason());
    let cases: [(&str, Result<Episode, Rejection>); 18] = [
        ("magic", altered(|header, _| header.magic[0] = b'X')),
        ("layout_version", altered(|header, _| header.layout_version += 1)),
        ("run", altered(|header, _| header.run_id[3] ^= 1)),
        ("dims", altered(|header, _| header.entities_max = 8)),
        ("length", altered(|header, _| header.payload_len -= 8)),
        ("task", altered(|header, _| header.task = 4)),
        ("task", altered(|header, _| header.n_agents = 5)),
        ("steps", altered(|header, _| header.steps = 0)),
        ("steps", altered(|header, _| header.steps = 7)),
        ("flag", altered(|header, _| header.end = 0)),
        ("flag", altered(|header, _| header.won = 2)),
        ("flag", altered(|header, _| header.reserved[5] = 1)),
        ("flag", altered(|_, payload| payload[layout.observable] = 2)),
        ("decision_order", altered(|_, payload| payload[layout.decision_order] = 2)),
        ("action", altered(|_, payload| payload[layout.actions] = 3)),
        ("not_finite", altered(|_, payload| payload[..4].copy_from_slice(&f32::NAN.to_le_bytes()))),
        (
            "not_finite",
            altered(|_, payload| payload[layout.shaping..][..4].copy_from_slice(&f32::NAN.to_le_bytes())),
        ),
        (
            "action",
            altered(|_, payload| {
                let action = usize::from(payload[layout.actions]);
                payload[layout.available + action] = 0;
            }),
        ),
    ];
    for (name, result) in cases {
        assert_eq!(reason(result), Err(name));
    }
    let good = frame(&episode(0, 6, 1));
    let short = decode(&good.header, &good.payload[..8], &expected());
    assert_eq!(reason(short), Err("length"));
    let broken = Header { checksum: !good.header.checksum, ..good.header };
    assert_eq!(reason(decode(&broken, &good.payload, &expected())), Err("checksum"));
}

#[test]
fn a_header_comes_as_bytes_of_any_alignment() {
    let header = frame(&episode(0, 6, 1)).header;
    let shifted = [&[0], header.as_bytes()].concat();
    assert_eq!(Header::from_bytes(&shifted[1..]), Ok(header));
    assert_eq!(Header::from_bytes(&shifted), Err(Rejection::Header { found: 89 }));
    assert_eq!(Header::from_bytes(&[]).unwrap_err().reason(), "header");
}
