//! What a worker and this program say to each other: frames over a byte stream. `deploy/docs/environments.md` describes them
//! for authors of the other side; nothing that comes from there is trusted.
//!
//! A frame is the length of its body (u32), its kind (u16) and the environment it is about (u16), all little-endian, then
//! the body.

use rit_episode::{End, Observation};
use serde::{Deserialize, Serialize};

/// What this build speaks. Raise it when a frame changes its meaning.
pub const PROTOCOL_VERSION: u32 = 1;

/// Bytes before a body.
pub const HEADER_BYTES: usize = 8;

/// No body is longer: it holds a state of the largest sizes that there are.
pub const BODY_BYTES_MAX: usize = 1 << 26;

/// What the program asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Request {
    /// Say who you are; JSON [`Hello`].
    Hello = 0,
    /// Make an environment; JSON [`Open`].
    Open = 1,
    /// Begin an episode; a seed, u64.
    Reset = 2,
    /// Take a joint action; a byte an agent.
    Step = 3,
    /// Forget an environment; no answer.
    Close = 4,
}

/// The first request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// See [`PROTOCOL_VERSION`].
    pub protocol: u32,
}

/// Asks for an environment.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Open {
    /// The task's name.
    pub task: String,
    /// Features and actions to fill up to; 0: as many as it has.
    pub n_features: usize,
    /// Likewise.
    pub n_actions: usize,
    /// Whether to find out what [`Opened::is_reproducible`] says.
    pub describe: bool,
}

/// What an environment is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Opened {
    /// Agents.
    pub n_agents: usize,
    /// Agents and all else.
    pub n_entities: usize,
    /// Features of an entity, before filling up.
    pub n_features: usize,
    /// Actions, before filling up.
    pub n_actions: usize,
    /// The longest episode.
    pub steps_max: usize,
    /// Whether it knows winning.
    pub has_wins: bool,
    /// What features are called.
    pub feature_names: Vec<String>,
    /// What actions are called.
    pub action_names: Vec<String>,
    /// Whether the same seed and actions gave the same episode, if that was asked.
    pub is_reproducible: Option<bool>,
}

/// An error of the environment's own.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failed {
    /// In a line.
    pub error: String,
    /// File, line and function that raised it.
    #[serde(default)]
    pub place: String,
    /// The whole traceback.
    pub traceback: String,
}

/// A state, and what led to it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Arrived {
    /// The state.
    pub observation: Observation,
    /// Team reward; 0 after a reset.
    pub reward: f32,
    /// How the episode ended, if it has.
    pub end: Option<End>,
    /// Whether the team has won.
    pub won: bool,
}

/// What a worker answers.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer {
    /// To [`Request::Hello`].
    Welcome,
    /// To [`Request::Open`].
    Opened(Box<Opened>),
    /// To [`Request::Reset`] and [`Request::Step`].
    State,
    /// To anything.
    Failed(Box<Failed>),
}

/// A frame's beginning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Bytes of the body.
    pub len: usize,
    /// What it is.
    pub kind: u16,
    /// Which environment it is about.
    pub environment: u16,
}

/// What no worker may say.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ProtocolError {
    /// A body beyond all reason.
    #[error("an answer of {0} bytes; the most there may be is {BODY_BYTES_MAX}")]
    Length(usize),
    /// A kind of answer that there is not.
    #[error("an answer of kind {0}, which there is not")]
    Kind(u16),
    /// JSON that is none, or not the right one.
    #[error("an answer that cannot be read: {0}")]
    Json(String),
    /// Another protocol.
    #[error("protocol {0}; this program speaks {PROTOCOL_VERSION}: install the package of the same version")]
    Version(u32),
    /// A state of another length than its task has.
    #[error("a state of {found} bytes where its task has {expected}")]
    StateLength {
        /// Bytes.
        found: usize,
        /// As many as there should be.
        expected: usize,
    },
    /// An end that there is not.
    #[error("an end of kind {0}; 0 goes on, 1 is terminated, 2 truncated")]
    End(u8),
    /// A reward that is no number.
    #[error("a reward of {0}; rewards are finite numbers")]
    Reward(f32),
    /// A state that may not be.
    #[error(transparent)]
    State(#[from] rit_episode::ObservationFault),
}

/// Sizes of a task's states as they travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StateSizes {
    /// n.
    pub n_agents: usize,
    /// m.
    pub n_entities: usize,
    /// Features of an entity, filled up.
    pub n_features: usize,
    /// A, filled up.
    pub n_actions: usize,
}

impl StateSizes {
    /// Bytes of a state's body.
    pub fn bytes(&self) -> usize {
        let Self { n_agents, n_entities, n_features, n_actions } = *self;
        6 + 4 * n_entities * n_features + n_agents * (n_entities + n_actions)
    }
}

/// A whole request.
pub fn request(kind: Request, environment: u16, body: &[u8]) -> Vec<u8> {
    let mut frame = Vec::with_capacity(HEADER_BYTES + body.len());
    frame.extend_from_slice(&(body.len() as u32).to_le_bytes());
    frame.extend_from_slice(&(kind as u16).to_le_bytes());
    frame.extend_from_slice(&environment.to_le_bytes());
    frame.extend_from_slice(body);
    frame
}

/// The beginning of an answer.
///
/// # Errors
/// When its body is too long to be read.
pub fn header(bytes: [u8; HEADER_BYTES]) -> Result<Header, ProtocolError> {
    let [a, b, c, d, e, f, g, h] = bytes;
    let len = u32::from_le_bytes([a, b, c, d]) as usize;
    if len > BODY_BYTES_MAX {
        return Err(ProtocolError::Length(len));
    }
    Ok(Header { len, kind: u16::from_le_bytes([e, f]), environment: u16::from_le_bytes([g, h]) })
}

/// Reads an answer. A state's body is left to [`read_state`].
///
/// # Errors
/// When it is none.
pub fn answer(kind: u16, body: &[u8]) -> Result<Answer, ProtocolError> {
    match kind {
        0 => {
            let Hello { protocol } = json(body)?;
            if protocol == PROTOCOL_VERSION {
                Ok(Answer::Welcome)
            } else {
                Err(ProtocolError::Version(protocol))
            }
        }
        1 => json(body).map(|opened| Answer::Opened(Box::new(opened))),
        2 => Ok(Answer::State),
        3 => json(body).map(|failed| Answer::Failed(Box::new(failed))),
        kind => Err(ProtocolError::Kind(kind)),
    }
}

fn json<T: for<'a> Deserialize<'a>>(body: &[u8]) -> Result<T, ProtocolError> {
    serde_json::from_slice(body).map_err(|error| ProtocolError::Json(error.to_string()))
}

/// Reads a state of these sizes into `arrived`: reward f32, end u8, won u8, features f32, observable u8, available u8.
///
/// # Errors
/// When it has another length, or is none that may be.
pub fn read_state(body: &[u8], sizes: &StateSizes, arrived: &mut Arrived) -> Result<(), ProtocolError> {
    let StateSizes { n_agents: n, n_entities: m, n_features, n_actions } = *sizes;
    let expected = sizes.bytes();
    let wrong_length = ProtocolError::StateLength { found: body.len(), expected };
    if body.len() != expected {
        return Err(wrong_length);
    }
    let [a, b, c, d, end, won, ref rest @ ..] = *body else { return Err(wrong_length) };
    arrived.reward = f32::from_le_bytes([a, b, c, d]);
    if !arrived.reward.is_finite() {
        return Err(ProtocolError::Reward(arrived.reward));
    }
    arrived.end = match end {
        0 => None,
        1 => Some(End::Terminated),
        2 => Some(End::Truncated),
        end => return Err(ProtocolError::End(end)),
    };
    arrived.won = won != 0;
    let (features, flags) = rest.split_at(4 * m * n_features);
    let (observable, available) = flags.split_at(n * m);
    let observation = &mut arrived.observation;
    observation.reset(n, m, n_features, n_actions);
    let (numbers, _) = features.as_chunks::<4>();
    for entity in 0..m {
        let of_entity = &numbers[entity * n_features..][..n_features];
        for (to, &number) in observation.entity_mut(entity).iter_mut().zip(of_entity) {
            *to = f32::from_le_bytes(number);
        }
    }
    for agent in 0..n {
        observation.observable_mut(agent).copy_from_slice(&observable[agent * m..][..m]);
        observation.available_mut(agent).copy_from_slice(&available[agent * n_actions..][..n_actions]);
    }
    Ok(observation.check()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZES: StateSizes = StateSizes { n_agents: 1, n_entities: 2, n_features: 2, n_actions: 3 };

    /// By hand: reward 0.5, cut off, not won; two entities; all seen; the second action barred.
    fn state() -> Vec<u8> {
        let mut body = 0.5_f32.to_le_bytes().to_vec();
        body.extend([2, 0]);
        body.extend([1.0_f32, 2.0, 3.0, -4.0].map(f32::to_le_bytes).as_flattened());
        body.extend([1, 1]);
        body.extend([1, 0, 1]);
        body
    }

    #[test]
    fn a_state_by_hand() {
        let mut arrived = Arrived::default();
        read_state(&state(), &SIZES, &mut arrived).unwrap();
        let Arrived { observation, reward, end, won } = arrived;
        assert_eq!((reward, end, won), (0.5, Some(End::Truncated), false));
        assert_eq!(observation.entities(), [1.0, 2.0, 3.0, -4.0]);
        assert_eq!(
            (observation.observable(), observation.available()),
            ([1, 1].as_slice(), [1, 0, 1].as_slice())
        );
    }

    #[test]
    fn what_may_not_be_is_named() {
        let refused = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut body = state();
            change(&mut body);
            read_state(&body, &SIZES, &mut Arrived::default()).unwrap_err().to_string()
        };
        assert_eq!(refused(&|body| body.truncate(20)), "a state of 20 bytes where its task has 27");
        assert_eq!(refused(&|body| body[4] = 9), "an end of kind 9; 0 goes on, 1 is terminated, 2 truncated");
        assert_eq!(
            refused(&|body| body[..4].copy_from_slice(&f32::NAN.to_le_bytes())),
            "a reward of NaN; rewards are finite numbers"
        );
        assert!(
            refused(&|body| body[6..10].copy_from_slice(&f32::INFINITY.to_le_bytes()))
                .contains("feature 0 of entity 0 is inf")
        );
        assert!(refused(&|body| body[24..].fill(0)).contains("agent 0 has no available action"));
        assert!(refused(&|body| body[22] = 7).contains("observable of agent 0 has 7 for 0"));
    }

    #[test]
    fn frames_and_words() {
        assert_eq!(request(Request::Step, 513, &[7, 8]), [2, 0, 0, 0, 3, 0, 1, 2, 7, 8]);
        let read = header([2, 0, 0, 0, 3, 0, 1, 2]).unwrap();
        assert_eq!(read, Header { len: 2, kind: 3, environment: 513 });
        assert_eq!(header([0xff; 8]), Err(ProtocolError::Length(u32::MAX as usize)));
        assert_eq!(answer(9, b""), Err(ProtocolError::Kind(9)));
        assert_eq!(answer(0, br#"{"protocol": 1, "python": "3.11"}"#), Ok(Answer::Welcome));
        assert_eq!(answer(0, br#"{"protocol": 2}"#), Err(ProtocolError::Version(2)));
        assert!(answer(1, b"{").unwrap_err().to_string().starts_with("an answer that cannot be read: EOF"));
        let failed = answer(3, br#"{"error": "E: x", "traceback": "T"}"#);
        let expected = Failed { error: "E: x".into(), place: String::new(), traceback: "T".into() };
        assert_eq!(failed, Ok(Answer::Failed(Box::new(expected))));
    }
}
