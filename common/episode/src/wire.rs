//! How an episode lies in shared memory: a fixed [`Header`] and a padded payload, plain old data both.
//!
//! The payload's sections follow one another in this order, without gaps. All are padded to the run's
//! [`Dims`]; everything is little-endian; padding is zero.
//!
//! | section | type | shape |
//! |---|---|---|
//! | entities | f32 | `[T + 1, m, d]`: agents in decision order, padded agents up to `n`, non-agents, padding |
//! | rewards | f32 | `[T]` |
//! | shaping | f32 | `[T]` |
//! | observable | u8 | `[T + 1, n, m]` |
//! | available | u8 | `[T + 1, n, A]` |
//! | actions | u8 | `[T, n]` |
//! | decision order | u8 | `[n]` |
//!
//! What arrives is not trusted: [`decode`] checks everything before an [`Episode`] exists.

mod rejection;

pub use rejection::Rejection;

use crate::{Dims, End, Episode, decision_order};
use bytemuck::{Pod, Zeroable};

/// First bytes of every header.
pub const MAGIC: [u8; 8] = *b"RITEPSD\0";

/// Changes whenever header or payload change their meaning.
pub const LAYOUT_VERSION: u32 = 2;

/// Alignment of header and payload, in bytes.
pub const ALIGNMENT: usize = 8;

/// What a run's frames have in common beside their dims: a stray frame of another run is refused.
pub type RunId = [u8; 16];

/// The fixed part of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Header {
    /// [`MAGIC`].
    pub magic: [u8; 8],
    /// [`LAYOUT_VERSION`].
    pub layout_version: u32,
    /// CRC-32 of this header with the checksum zero, then of the payload.
    pub checksum: u32,
    /// The run this frame belongs to.
    pub run_id: RunId,
    /// Episode number.
    pub episode: u64,
    /// Weights the episode was rolled with.
    pub weights_version: u64,
    /// Payload length in bytes.
    pub payload_len: u64,
    /// Who rolled it.
    pub actor: u32,
    /// Index among the run's training tasks.
    pub task: u32,
    /// d.
    pub entity_dim: u16,
    /// A.
    pub n_actions: u16,
    /// n.
    pub agents_max: u16,
    /// m.
    pub entities_max: u16,
    /// T.
    pub steps_max: u16,
    /// Real agents.
    pub n_agents: u16,
    /// Real entities, agents included.
    pub n_entities: u16,
    /// Real decision steps: the filled ones.
    pub steps: u16,
    /// 1 terminated, 2 truncated.
    pub end: u8,
    /// 1 won, 0 not.
    pub won: u8,
    /// Zero.
    pub reserved: [u8; 6],
}

impl Header {
    /// A header that came as bytes, of any alignment. Nothing it says has been checked yet.
    ///
    /// # Errors
    /// When they are not as many as a header has.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, Rejection> {
        bytemuck::try_pod_read_unaligned(bytes).map_err(|_| Rejection::Header { found: bytes.len() })
    }

    /// Its bytes.
    pub fn as_bytes(&self) -> &[u8] {
        bytemuck::bytes_of(self)
    }
}

// `Pod` already refuses padding between fields. A frame made by another build must mean the same.
const _: () = assert!(size_of::<Header>() == 88);
const _: () = assert!(align_of::<Header>() == ALIGNMENT);
const _: () = assert!(size_of::<Header>().is_multiple_of(ALIGNMENT));

/// Where the payload's sections begin, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PayloadLayout {
    dims: Dims,
    rewards: usize,
    shaping: usize,
    observable: usize,
    available: usize,
    actions: usize,
    decision_order: usize,
    len: usize,
}

impl PayloadLayout {
    /// The layout of a run's payloads.
    pub fn new(dims: Dims) -> Self {
        let Dims { entity_dim, n_actions, agents_max, entities_max, steps_max } = dims;
        let rows = steps_max + 1;
        let rewards = 4 * rows * entities_max * entity_dim;
        let shaping = rewards + 4 * steps_max;
        let observable = shaping + 4 * steps_max;
        let available = observable + rows * agents_max * entities_max;
        let actions = available + rows * agents_max * n_actions;
        let decision_order = actions + steps_max * agents_max;
        let len = (decision_order + agents_max).next_multiple_of(ALIGNMENT);
        Self { dims, rewards, shaping, observable, available, actions, decision_order, len }
    }

    /// Bytes of a payload.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Never: an episode has at least one step.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
}

/// The real sizes of a task, as both sides know them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TaskSize {
    /// Real agents.
    pub n_agents: usize,
    /// Real entities, agents included.
    pub n_entities: usize,
}

/// An episode that does not fit the run's dims: a fault of the sender's own.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("an episode of {n_agents} agents, {n_entities} entities and {steps} steps does not fit {dims:?}")]
pub struct EncodeError {
    /// Real agents.
    pub n_agents: usize,
    /// Real entities.
    pub n_entities: usize,
    /// Decision steps.
    pub steps: usize,
    /// The run's dims.
    pub dims: Dims,
}

/// A frame in private memory, reused from episode to episode.
#[derive(Clone, Debug)]
pub struct Frame {
    /// The fixed part.
    pub header: Header,
    /// The padded part.
    pub payload: Vec<u8>,
}

impl Frame {
    /// A frame of zeros of the layout's length: what [`encode`] writes into.
    pub fn new(layout: &PayloadLayout) -> Self {
        Self { header: Header::zeroed(), payload: vec![0; layout.len()] }
    }
}

/// Pads an episode into a frame.
///
/// # Errors
/// When the episode is larger than the dims or its buffers are not of its own sizes.
pub fn encode(
    episode: &Episode,
    layout: &PayloadLayout,
    run_id: RunId,
    actor: u32,
    frame: &mut Frame,
) -> Result<(), EncodeError> {
    if !fits(episode, layout.dims) {
        let Episode { n_agents, n_entities, .. } = *episode;
        return Err(EncodeError { n_agents, n_entities, steps: episode.steps(), dims: layout.dims });
    }
    frame.payload.clear();
    frame.payload.resize(layout.len, 0);
    pad(episode, layout, &mut frame.payload);
    frame.header = header_of(episode, layout, run_id, actor);
    frame.header.checksum = checksum(&frame.header, &frame.payload);
    Ok(())
}

/// Whether an episode is no larger than the dims, and its buffers are of its own sizes.
fn fits(episode: &Episode, dims: Dims) -> bool {
    let Dims { entity_dim: d, n_actions, agents_max, entities_max, steps_max } = dims;
    let (n, m, steps) = (episode.n_agents, episode.n_entities, episode.steps());
    n >= 1
        && n <= agents_max
        && m >= n
        && m - n <= entities_max - agents_max
        && (1..=steps_max).contains(&steps)
        && episode.entities.len() == (steps + 1) * m * d
        && episode.observable.len() == (steps + 1) * n * m
        && episode.available.len() == (steps + 1) * n * n_actions
        && episode.actions.len() == steps * n
        && episode.shaping.len() == steps
        && episode.decision_order.len() == n
}

/// Writes an episode that [`fits`] into a payload of zeros.
fn pad(episode: &Episode, layout: &PayloadLayout, payload: &mut [u8]) {
    let Dims { entity_dim: d, n_actions, agents_max, entities_max, .. } = layout.dims;
    let (n, m, steps) = (episode.n_agents, episode.n_entities, episode.steps());
    for time in 0..=steps {
        for row in 0..m {
            let to = 4 * d * (time * entities_max + padded_entity(row, n, agents_max));
            let from = &episode.entities[(time * m + row) * d..][..d];
            payload[to..to + 4 * d].copy_from_slice(bytemuck::cast_slice(from));
        }
        for agent in 0..n {
            let seen = &episode.observable[(time * n + agent) * m..][..m];
            let to = layout.observable + (time * agents_max + agent) * entities_max;
            payload[to..to + n].copy_from_slice(&seen[..n]);
            payload[to + agents_max..to + agents_max + m - n].copy_from_slice(&seen[n..]);
            let to = layout.available + (time * agents_max + agent) * n_actions;
            payload[to..to + n_actions]
                .copy_from_slice(&episode.available[(time * n + agent) * n_actions..][..n_actions]);
        }
    }
    payload[layout.rewards..][..4 * steps].copy_from_slice(bytemuck::cast_slice(&episode.rewards));
    payload[layout.shaping..][..4 * steps].copy_from_slice(bytemuck::cast_slice(&episode.shaping));
    for time in 0..steps {
        payload[layout.actions + time * agents_max..][..n].copy_from_slice(&episode.actions[time * n..][..n]);
    }
    payload[layout.decision_order..][..n].copy_from_slice(&episode.decision_order);
}

/// The header of an episode that [`fits`]; its checksum is still to come.
fn header_of(episode: &Episode, layout: &PayloadLayout, run_id: RunId, actor: u32) -> Header {
    let Dims { entity_dim, n_actions, agents_max, entities_max, steps_max } = layout.dims;
    // Limits of `Dims` make every narrowing below exact.
    Header {
        magic: MAGIC,
        layout_version: LAYOUT_VERSION,
        checksum: 0,
        run_id,
        episode: episode.number,
        weights_version: episode.weights_version,
        payload_len: layout.len as u64,
        actor,
        task: episode.task as u32,
        entity_dim: entity_dim as u16,
        n_actions: n_actions as u16,
        agents_max: agents_max as u16,
        entities_max: entities_max as u16,
        steps_max: steps_max as u16,
        n_agents: episode.n_agents as u16,
        n_entities: episode.n_entities as u16,
        steps: episode.steps() as u16,
        end: match episode.end {
            End::Terminated => 1,
            End::Truncated => 2,
        },
        won: u8::from(episode.won),
        reserved: [0; 6],
    }
}

/// What a receiver knows of a run before a frame arrives.
#[derive(Clone, Debug)]
pub struct Expected {
    /// The run.
    pub run_id: RunId,
    /// The layout of its payloads.
    pub layout: PayloadLayout,
    /// The sizes of its training tasks, by index.
    pub tasks: Vec<TaskSize>,
}

/// Checks a frame and copies its real rows out: the receiver's only copy.
///
/// # Errors
/// The first thing found wrong. No bytes make it panic.
pub fn decode(header: &Header, payload: &[u8], expected: &Expected) -> Result<Episode, Rejection> {
    check_header(header, payload, expected)?;
    let episode = real_rows(header, payload, &expected.layout);
    check_contents(&episode, expected.layout.dims.n_actions)?;
    Ok(episode)
}

/// An episode's real rows, whatever they hold. The header has been checked against the payload.
fn real_rows(header: &Header, payload: &[u8], layout: &PayloadLayout) -> Episode {
    let Dims { entity_dim: d, n_actions, agents_max, entities_max, .. } = layout.dims;
    let (n, m) = (usize::from(header.n_agents), usize::from(header.n_entities));
    let steps = usize::from(header.steps);
    let mut entities = Vec::with_capacity((steps + 1) * m * d);
    let mut observable = Vec::with_capacity((steps + 1) * n * m);
    let mut available = Vec::with_capacity((steps + 1) * n * n_actions);
    for time in 0..=steps {
        // Agents lie together, and so do the others: two runs of rows each.
        for (first, rows) in [(0, n), (agents_max, m - n)] {
            let from = 4 * d * (time * entities_max + first);
            extend_f32(&mut entities, &payload[from..from + 4 * d * rows]);
        }
        for agent in 0..n {
            let seen = &payload[layout.observable + (time * agents_max + agent) * entities_max..];
            observable.extend_from_slice(&seen[..n]);
            observable.extend_from_slice(&seen[agents_max..agents_max + m - n]);
            let allowed = &payload[layout.available + (time * agents_max + agent) * n_actions..];
            available.extend_from_slice(&allowed[..n_actions]);
        }
    }
    let (mut rewards, mut shaping) = (Vec::with_capacity(steps), Vec::with_capacity(steps));
    extend_f32(&mut rewards, &payload[layout.rewards..layout.rewards + 4 * steps]);
    extend_f32(&mut shaping, &payload[layout.shaping..layout.shaping + 4 * steps]);
    let mut actions = Vec::with_capacity(steps * n);
    for time in 0..steps {
        actions.extend_from_slice(&payload[layout.actions + time * agents_max..][..n]);
    }
    Episode {
        number: header.episode,
        weights_version: header.weights_version,
        task: header.task as usize,
        n_agents: n,
        n_entities: m,
        decision_order: payload[layout.decision_order..][..n].to_vec(),
        entities,
        observable,
        available,
        actions,
        rewards,
        shaping,
        end: if header.end == 1 { End::Terminated } else { End::Truncated },
        won: header.won == 1,
    }
}

/// Everything that can be said of an episode's rows.
fn check_contents(episode: &Episode, n_actions: usize) -> Result<(), Rejection> {
    let Episode { entities, rewards, shaping, observable, available, .. } = episode;
    for (section, numbers) in [("entities", entities), ("rewards", rewards), ("shaping", shaping)] {
        if !numbers.iter().fold(true, |finite, number| finite & number.is_finite()) {
            return Err(Rejection::NotFinite { section });
        }
    }
    for (section, flags) in [("observable", observable), ("available", available)] {
        let worst = flags.iter().fold(0, |worst, &flag| worst.max(flag));
        if worst > 1 {
            return Err(Rejection::Flag { field: section, value: worst });
        }
    }
    if !decision_order::is_permutation(&episode.decision_order) {
        return Err(Rejection::DecisionOrder);
    }
    let allowed = available.chunks_exact(n_actions);
    for (row, (&action, allowed)) in episode.actions.iter().zip(allowed).enumerate() {
        if allowed.get(usize::from(action)) != Some(&1) {
            let (step, agent) = (row / episode.n_agents, row % episode.n_agents);
            return Err(Rejection::Action { step, agent, action });
        }
    }
    Ok(())
}

/// Everything that can be said before the payload is read, and the checksum over both.
fn check_header(header: &Header, payload: &[u8], expected: &Expected) -> Result<(), Rejection> {
    let dims = expected.layout.dims;
    if header.magic != MAGIC {
        return Err(Rejection::Magic);
    }
    if header.layout_version != LAYOUT_VERSION {
        return Err(Rejection::LayoutVersion { found: header.layout_version });
    }
    if header.run_id != expected.run_id {
        return Err(Rejection::Run);
    }
    let found =
        [header.entity_dim, header.n_actions, header.agents_max, header.entities_max, header.steps_max];
    let run = [dims.entity_dim, dims.n_actions, dims.agents_max, dims.entities_max, dims.steps_max];
    if found.map(usize::from) != run {
        return Err(Rejection::Dims);
    }
    if payload.len() != expected.layout.len || header.payload_len != expected.layout.len as u64 {
        return Err(Rejection::Length { found: payload.len(), expected: expected.layout.len });
    }
    if header.checksum != checksum(header, payload) {
        return Err(Rejection::Checksum);
    }
    let size = TaskSize { n_agents: header.n_agents.into(), n_entities: header.n_entities.into() };
    if expected.tasks.get(header.task as usize) != Some(&size) {
        let Header { task, n_agents, n_entities, .. } = *header;
        return Err(Rejection::Task { task, n_agents, n_entities });
    }
    if header.steps == 0 || usize::from(header.steps) > dims.steps_max {
        return Err(Rejection::Steps { found: header.steps, limit: dims.steps_max });
    }
    if !(1..=2).contains(&header.end) {
        return Err(Rejection::Flag { field: "end", value: header.end });
    }
    if header.won > 1 {
        return Err(Rejection::Flag { field: "won", value: header.won });
    }
    if let Some(&value) = header.reserved.iter().find(|&&byte| byte != 0) {
        return Err(Rejection::Flag { field: "reserved", value });
    }
    Ok(())
}

fn checksum(header: &Header, payload: &[u8]) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    crc.update(bytemuck::bytes_of(&Header { checksum: 0, ..*header }));
    crc.update(payload);
    crc.finalize()
}

/// A real entity's row in the padded order: non-agents begin after the padded agents.
fn padded_entity(row: usize, n_agents: usize, agents_max: usize) -> usize {
    if row < n_agents { row } else { row - n_agents + agents_max }
}

fn extend_f32(to: &mut Vec<f32>, bytes: &[u8]) {
    let (numbers, _) = bytes.as_chunks::<4>();
    to.extend(numbers.iter().map(|&number| f32::from_le_bytes(number)));
}

#[cfg(test)]
mod tests;
