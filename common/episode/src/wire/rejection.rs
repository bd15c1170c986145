//! Why a frame does not get in.

use super::{Header, LAYOUT_VERSION};

/// Why a frame was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Rejection {
    /// Bytes that cannot be a header.
    #[error("the frame's header has {found} bytes, {} were expected", size_of::<Header>())]
    Header {
        /// Bytes found.
        found: usize,
    },
    /// Not one of our frames.
    #[error("the frame does not begin with RITEPSD")]
    Magic,
    /// Made by another build.
    #[error("the frame's layout is version {found}, this build reads {LAYOUT_VERSION}")]
    LayoutVersion {
        /// Version found.
        found: u32,
    },
    /// A frame of another run.
    #[error("the frame belongs to another run")]
    Run,
    /// Padded sizes other than the run's.
    #[error("the frame's dims are not the run's")]
    Dims,
    /// More or fewer bytes than the header or the dims say.
    #[error("the frame's payload has {found} bytes, {expected} were expected")]
    Length {
        /// Bytes found.
        found: usize,
        /// Bytes expected.
        expected: usize,
    },
    /// Bytes changed on the way.
    #[error("the frame's checksum does not match its bytes")]
    Checksum,
    /// No such task, or sizes other than the task's.
    #[error(
        "the frame's task {task} with {n_agents} agents and {n_entities} entities is not one of the run's"
    )]
    Task {
        /// Task index found.
        task: u32,
        /// Agents found.
        n_agents: u16,
        /// Entities found.
        n_entities: u16,
    },
    /// No step, or more than the dims allow.
    #[error("the frame has {found} steps, 1..={limit} are allowed")]
    Steps {
        /// Steps found.
        found: u16,
        /// Most steps.
        limit: usize,
    },
    /// A flag that is neither of its values.
    #[error("the frame's {field} holds {value}")]
    Flag {
        /// The header's field or the payload's section.
        field: &'static str,
        /// What it held.
        value: u8,
    },
    /// Not a permutation of the agents.
    #[error("the frame's decision order is not a permutation")]
    DecisionOrder,
    /// An action out of range or one that was not available.
    #[error("the frame's action {action} of agent {agent} at step {step} was not available")]
    Action {
        /// Decision step.
        step: usize,
        /// Row of the agent.
        agent: usize,
        /// Action found.
        action: u8,
    },
    /// NaN or infinite.
    #[error("the frame's {section} hold a number that is not finite")]
    NotFinite {
        /// The payload's section.
        section: &'static str,
    },
}

impl Rejection {
    /// A short name for counting.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Header { .. } => "header",
            Self::Magic => "magic",
            Self::LayoutVersion { .. } => "layout_version",
            Self::Run => "run",
            Self::Dims => "dims",
            Self::Length { .. } => "length",
            Self::Checksum => "checksum",
            Self::Task { .. } => "task",
            Self::Steps { .. } => "steps",
            Self::Flag { .. } => "flag",
            Self::DecisionOrder => "decision_order",
            Self::Action { .. } => "action",
            Self::NotFinite { .. } => "not_finite",
        }
    }
}
