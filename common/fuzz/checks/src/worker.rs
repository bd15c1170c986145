//! What a worker that holds environments says: see [`rit_foreign::protocol`].

use rit_episode::End;
use rit_foreign::protocol::{Answer, Arrived, HEADER_BYTES, Header, StateSizes, answer, header, read_state};

/// Reads an input as the sizes of a task (a byte each) and the frames that come from a worker. What is accepted as a
/// state, written again and read again, is the same state. Returns whether there was a frame and all were accepted.
pub fn check(input: &[u8]) -> bool {
    let Some(([agents, others, features, actions], mut rest)) = input.split_first_chunk::<4>() else {
        return false;
    };
    let n_agents = 1 + usize::from(agents % 8);
    let sizes = StateSizes {
        n_agents,
        n_entities: n_agents + usize::from(others % 8),
        n_features: 1 + usize::from(features % 16),
        n_actions: 1 + usize::from(actions % 16),
    };
    let mut frames = 0;
    while let Some((beginning, after)) = rest.split_first_chunk::<HEADER_BYTES>() {
        let Ok(Header { len, kind, .. }) = header(*beginning) else { return false };
        let Some((body, behind)) = after.split_at_checked(len) else { return false };
        match answer(kind, body) {
            Ok(Answer::State) if !check_state(body, &sizes) => return false,
            Ok(_) => frames += 1,
            Err(_) => return false,
        }
        rest = behind;
    }
    frames > 0 && rest.is_empty()
}

fn check_state(body: &[u8], sizes: &StateSizes) -> bool {
    let mut arrived = Arrived::default();
    if read_state(body, sizes, &mut arrived).is_err() {
        return false;
    }
    assert_eq!(arrived.observation.check(), Ok(()), "an accepted state may be");
    let written = state(&arrived);
    let mut again = Arrived::default();
    assert_eq!(read_state(&written, sizes, &mut again), Ok(()), "what is written can be read");
    assert_eq!(again, arrived);
    true
}

/// A state as a worker writes it.
fn state(arrived: &Arrived) -> Vec<u8> {
    let Arrived { observation, reward, end, won } = arrived;
    let end = match end {
        None => 0,
        Some(End::Terminated) => 1,
        Some(End::Truncated) => 2,
    };
    let mut body = reward.to_le_bytes().to_vec();
    body.extend([end, u8::from(*won)]);
    body.extend(observation.entities().iter().flat_map(|feature| feature.to_le_bytes()));
    body.extend_from_slice(observation.observable());
    body.extend_from_slice(observation.available());
    body
}

fn frame(kind: u16, body: &[u8]) -> Vec<u8> {
    let mut frame = (body.len() as u32).to_le_bytes().to_vec();
    frame.extend(kind.to_le_bytes());
    frame.extend(7_u16.to_le_bytes());
    frame.extend_from_slice(body);
    frame
}

/// Whole inputs to begin from, by name.
pub fn seeds() -> Vec<(String, Vec<u8>)> {
    let mut observation = rit_episode::Observation::new(2, 3, 2, 3);
    observation.see_and_allow_all();
    let arrived = |end| Arrived { observation: observation.clone(), reward: 0.5, end, won: false };
    let opened = br#"{"n_agents":2,"n_entities":3,"n_features":2,"n_actions":3,"steps_max":25,"has_wins":false,"feature_names":["x","y"],"action_names":["a","b","c"],"is_reproducible":true}"#;
    let failed = br#"{"error":"KeyError: 1","place":"worlds.py:7, in step","traceback":"Traceback"}"#;
    let frames = [
        ("welcome", frame(0, br#"{"protocol":1}"#)),
        ("opened", frame(1, opened)),
        ("state", frame(2, &state(&arrived(None)))),
        ("end", frame(2, &state(&arrived(Some(End::Terminated))))),
        ("failed", frame(3, failed)),
    ];
    let sizes = [1, 1, 1, 2];
    let mut seeds: Vec<(String, Vec<u8>)> =
        frames.iter().map(|(name, frame)| ((*name).to_owned(), [&sizes[..], frame].concat())).collect();
    let all: Vec<u8> = frames.into_iter().flat_map(|(_, frame)| frame).collect();
    seeds.push(("course".to_owned(), [&sizes[..], &all].concat()));
    seeds
}
