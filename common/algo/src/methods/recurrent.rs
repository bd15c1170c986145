//! The recurrent networks over attention: RIT, its ablations, and the rivals that differ from it in one part each.
//!
//! An encoder over entities, a GRU, then either a linear head for each agent by itself or RIT's decoder over the actions
//! of those before it; Q_total by the mixing network or by a sum; task representations or none.

use crate::{
    ModelConfig,
    blocks::{Decoder, Discriminator, Encoder, Mixer, TaskEncoder, decoder::Tables},
    drive::{Head, Pass, Utilities, ValueNetwork, ValueParts, measures},
    learner::Measure,
    method,
};
use rit_nn::{Gru, Layout, LayoutBuilder, Linear, Tape, attention::Visible};

/// The utility network, and all else in [`ValueParts`].
#[derive(Clone, Debug)]
pub struct Recurrent {
    parts: ValueParts,
    /// Whether an agent's own features stand beside its attention.
    beside: bool,
    encoder: Encoder,
    gru: Gru,
    output: Output,
}

/// From histories to utilities.
#[derive(Clone, Debug)]
enum Output {
    /// h → A, each agent by itself.
    Linear(Linear),
    /// Each agent given the actions before its own.
    Decoder(Box<Decoder>),
}

impl Recurrent {
    /// Declares the networks. Parameters lie in the order utility, task encoder, mixer, discriminator, so what acting
    /// needs and what the target network covers are the first ones.
    pub fn new(config: &ModelConfig) -> Self {
        let (mut network, layout) = Layout::of(|layout| Self::declare(config, layout));
        network.parts.layout = layout;
        network
    }

    fn declare(config: &ModelConfig, layout: &mut LayoutBuilder) -> Self {
        let facts = config.method.facts();
        let (h, a) = (config.hidden_dim, config.attention_dim);
        let new_encoder = |layout: &mut LayoutBuilder, name| {
            Encoder::new(layout, name, config.entity_dim, h, a, config.n_heads)
        };
        let z = if facts.task_representations { config.task_representation_dim } else { 0 };
        let beside = config.encoder == method::Encoder::Beside;
        let encoder = new_encoder(layout, "utility");
        let gru = Gru::new(layout, "utility.gru", if beside { h + a } else { a }, h);
        let output = if facts.ordered {
            let heads = config.n_heads;
            Output::Decoder(Box::new(Decoder::new(layout, "utility", config.n_actions, h, a, heads, z)))
        } else {
            Output::Linear(Linear::new(layout, "utility.head", h, config.n_actions))
        };
        let task_encoder = facts.task_representations.then(|| {
            let encoder = new_encoder(layout, "task_encoder");
            TaskEncoder::new(layout, encoder, config.reward_embed_dim, z)
        });
        let acting = 0..layout.len();
        let mixer = (facts.mixing == Some(method::Mixing::Network)).then(|| {
            let encoder = new_encoder(layout, "mixer");
            Mixer::new(layout, encoder, z, config.mixing_embed_dim, config.hypernet_embed_dim)
        });
        let target = 0..layout.len();
        let task = task_encoder.map(|task_encoder| (task_encoder, Discriminator::new(layout, z, h)));
        let (layout, n_actions) = (Layout::default(), config.n_actions);
        let parts = ValueParts { layout, acting, target, n_actions, memory_dim: h, gru: true, mixer, task };
        Self { parts, beside, encoder, gru, output }
    }
}

impl ValueNetwork for Recurrent {
    type Draws = ();
    type Inputs = ();
    type Extras = ();

    fn parts(&self) -> &ValueParts {
        &self.parts
    }

    fn measures(&self) -> &'static [Measure] {
        if self.parts.task.is_some() { &measures::TD_AND_CONTRASTIVE } else { &measures::TD_OF_GRU }
    }

    fn tables(&self, params: &[f32]) -> Tables {
        match &self.output {
            Output::Linear(_) => Tables::default(),
            Output::Decoder(decoder) => decoder.tables(params),
        }
    }

    fn forward<'a>(&self, tape: &mut Tape<'a>, pass: Pass<'a, ()>) -> Utilities<'a, ()> {
        let rows = pass.rows;
        let encoded = if self.beside {
            self.encoder.beside(tape, rows)
        } else {
            self.encoder.within(tape, rows, &[Visible::Where(&rows.observable)])
        };
        let gates = tape.product_of(&self.gru.input, 0, &[encoded]);
        tape.free(encoded);
        let memory = tape.gru(&self.gru, gates, &rows.agent_times, pass.before);
        let head = match &self.output {
            Output::Linear(layer) => Head::Independent(tape.linear(layer, memory)),
            Output::Decoder(decoder) => {
                let prepared = decoder.prepare(tape, pass.tables, memory, pass.representation);
                Head::Ordered(Box::new((Decoder::clone(decoder), prepared)))
            }
        };
        Utilities { memory, head, extras: () }
    }
}
