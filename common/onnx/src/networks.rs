//! The networks as nodes: the formulas of `deploy/docs/weights.md`, part by part.

use crate::{
    OnnxError,
    graph::{Graph, Side, Value, int, int_list, int_tensor},
    messages::tensor_proto::DataType::{Bool, Float, Int64},
};
use rit_algo::{ModelConfig, method::Encoder};
use rit_policy::Weights;

/// In place of the scores of what is not seen: its weight is 0 beside any score.
const UNSEEN: f32 = -1e30;
const AGENTS: Side = Side::Any("agents");
const ENTITIES: Side = Side::Any("entities");

/// All agents' histories and task representations, from what they see.
pub fn encoder(weights: &Weights) -> Result<Graph<'_>, OnnxError> {
    let config = weights.model.config();
    let ModelConfig { hidden_dim: h, n_actions, task_representation_dim, .. } = *config;
    let memory = [AGENTS, Side::Fixed(h)];
    let mut graph = Graph::new(weights, "encoder");
    let g = &mut graph;
    let width = Side::Fixed(config.entity_dim - n_actions);
    let features = g.input("features", Float, &[ENTITIES, width], "features of every entity, agents first");
    let last_actions = g.input(
        "last_actions",
        Int64,
        &[AGENTS],
        "each agent's action of the step before; -1 at an episode's first",
    );
    let observable =
        g.input("observable", Bool, &[AGENTS, ENTITIES], "whether the row's agent sees the column's entity");
    let before =
        g.input("history_before", Float, &memory, "history of the step before; zeros at an episode's first");
    let seen = Seen::new(g, &features, &last_actions, observable, n_actions);
    let beside = config.encoder == Encoder::Beside;
    let history = remember(g, config, &seen, "utility", beside, None, &before)?;
    if config.method.facts().task_representations {
        let reward = g.input(
            "previous_reward",
            Float,
            &[Side::Fixed(1)],
            "the team's reward of the step before; 0 at an episode's first",
        );
        let before =
            g.input("task_memory_before", Float, &memory, "task_memory of the step before; zeros at first");
        let memory_now = remember(g, config, &seen, "task_encoder", true, Some(&reward), &before)?;
        let z = linear(g, "task_encoder.out", &memory_now)?;
        let shape = [AGENTS, Side::Fixed(task_representation_dim)];
        g.output(&z, "z", Float, &shape, "task representations");
        g.output(&memory_now, "task_memory", Float, &memory, "what the next step is given");
    }
    g.output(&history, "history", Float, &memory, "histories, which the next step is given");
    Ok(graph)
}

/// One agent's utilities, and its greedy action, from its history and what those before it do.
pub fn head(weights: &Weights) -> Result<Graph<'_>, OnnxError> {
    let config = weights.model.config();
    let ModelConfig { hidden_dim: h, n_actions, task_representation_dim, .. } = *config;
    let mut graph = Graph::new(weights, "head");
    let g = &mut graph;
    let history = g.input("history", Float, &[Side::Fixed(h)], "the agent's row of the encoder's history");
    let first = g.ints(&[0], &[1]);
    let history = g.op("Unsqueeze", &[&history, &first], vec![]);
    let facts = config.method.facts();
    let hidden = if facts.ordered {
        let z = facts.task_representations.then(|| {
            let shape = [Side::Fixed(task_representation_dim)];
            let z = g.input("z", Float, &shape, "the agent's row of the encoder's z");
            g.op("Unsqueeze", &[&z, &first], vec![])
        });
        let previous = g.input(
            "previous_actions",
            Int64,
            &[Side::Any("predecessors")],
            "actions of the agents that have decided before this one in this step, in their order",
        );
        let one = g.ints(&[1], &[]);
        let actions = g.op("Add", &[&previous, &one], vec![]);
        // Token 0 is the start's.
        let tokens = g.op("Concat", &[&first, &actions], vec![int("axis", 0)]);
        let table = g.weight("utility.action_embed.weight")?;
        let columns = g.op("Gather", &[&table, &tokens], vec![int("axis", 1)]);
        let embedded = g.op("Transpose", &[&columns], vec![int_list("perm", &[1, 0])]);
        let embedded = g.op("Relu", &[&embedded], vec![]);
        let context = attention(g, config, "utility.action_attention", &history, &embedded, None)?;
        let parts: Vec<&Value> = [Some(&history), Some(&context), z.as_ref()].into_iter().flatten().collect();
        let together = g.op("Concat", &parts, vec![int("axis", 1)]);
        let hidden = linear(g, "utility.head_hidden", &together)?;
        g.op("Relu", &[&hidden], vec![])
    } else {
        history
    };
    let row = linear(g, "utility.head", &hidden)?;
    let utilities = g.op("Squeeze", &[&row, &first], vec![]);
    let available = g.input(
        "available",
        Bool,
        &[Side::Fixed(n_actions)],
        "whether the agent may take the action; one it may",
    );
    let never = g.float(f32::NEG_INFINITY);
    let allowed = g.op("Where", &[&available, &utilities, &never], vec![]);
    let action = g.op("ArgMax", &[&allowed], vec![int("axis", 0), int("keepdims", 0)]);
    g.output(&utilities, "utilities", Float, &[Side::Fixed(n_actions)], "Q of each action");
    g.output(&action, "action", Int64, &[], "the available action of the largest Q, the first among equals");
    Ok(graph)
}

/// What agents see, for either encoder.
struct Seen {
    /// (m, d).
    entities: Value,
    /// n, as a shape of one side.
    n_agents: Value,
    /// (n, m).
    observable: Value,
    /// The same, itself left out.
    others: Value,
}

impl Seen {
    fn new(
        g: &mut Graph<'_>,
        features: &Value,
        last_actions: &Value,
        observable: Value,
        n_actions: usize,
    ) -> Self {
        let (rows, columns) = (g.ints(&[1], &[1]), g.ints(&[0], &[1]));
        let n_agents = g.op("Shape", &[last_actions], vec![]);
        let shape = g.op("Shape", &[features], vec![]);
        let n_entities = g.op("Slice", &[&shape, &columns, &rows], vec![]);
        // Entities that are no agents have done nothing.
        let others = g.op("Sub", &[&n_entities, &n_agents], vec![]);
        let nothing = g.op("ConstantOfShape", &[&others], vec![int_tensor("value", -1)]);
        let actions = g.op("Concat", &[last_actions, &nothing], vec![int("axis", 0)]);
        let actions = g.op("Unsqueeze", &[&actions, &rows], vec![]);
        let known = g.ints(&(0..n_actions as i64).collect::<Vec<_>>(), &[1, n_actions]);
        let is_action = g.op("Equal", &[&actions, &known], vec![]);
        let one_hot = g.op("Cast", &[&is_action], vec![int("to", Float as i64)]);
        let entities = g.op("Concat", &[features, &one_hot], vec![int("axis", 1)]);
        let (zero, one) = (g.ints(&[0], &[]), g.ints(&[1], &[]));
        let mut count = |count: &Value, axis: &Value| {
            let count = g.op("Squeeze", &[count, &columns], vec![]);
            let numbers = g.op("Range", &[&zero, &count, &one], vec![]);
            g.op("Unsqueeze", &[&numbers, axis], vec![])
        };
        let (agents, all) = (count(&n_agents, &rows), count(&n_entities, &columns));
        let itself = g.op("Equal", &[&agents, &all], vec![]);
        let not_itself = g.op("Not", &[&itself], vec![]);
        let others = g.op("And", &[&observable, &not_itself], vec![]);
        Self { entities, n_agents, observable, others }
    }
}

/// What each agent remembers after this step, (n, h).
fn remember(
    g: &mut Graph<'_>,
    config: &ModelConfig,
    seen: &Seen,
    name: &str,
    beside: bool,
    reward: Option<&Value>,
    before: &Value,
) -> Result<Value, OnnxError> {
    let first = g.ints(&[0], &[1]);
    let x = linear(g, &format!("{name}.embed"), &seen.entities)?;
    let x = g.op("Relu", &[&x], vec![]);
    let own = g.op("Slice", &[&x, &first, &seen.n_agents, &first], vec![]);
    let visible = if beside { &seen.others } else { &seen.observable };
    let attended = attention(g, config, &format!("{name}.attention"), &own, &x, Some(visible))?;
    let mut parts = if beside { vec![own, attended] } else { vec![attended] };
    if let Some(reward) = reward {
        let row = g.op("Unsqueeze", &[reward, &first], vec![]);
        let row = linear(g, "task_encoder.reward_embed", &row)?;
        let row = g.op("Relu", &[&row], vec![]);
        let one = g.ints(&[1], &[1]);
        let shape = g.op("Concat", &[&seen.n_agents, &one], vec![int("axis", 0)]);
        parts.push(g.op("Expand", &[&row, &shape], vec![]));
    }
    let encoded = match parts.as_slice() {
        [one] => one.clone(),
        _ => g.op("Concat", &parts.iter().collect::<Vec<_>>(), vec![int("axis", 1)]),
    };
    gru(g, &format!("{name}.gru"), config.hidden_dim, &encoded, before)
}

/// x Wᵀ + b.
fn linear(g: &mut Graph<'_>, name: &str, x: &Value) -> Result<Value, OnnxError> {
    let weight = g.weight(&format!("{name}.weight"))?;
    let bias = g.weight(&format!("{name}.bias"))?;
    Ok(g.op("Gemm", &[x, &weight, &bias], vec![int("transB", 1)]))
}

/// Attention of queries over keys, (rows, a); all keys are visible unless it is said which are. Who sees nothing gets zeros.
fn attention(
    g: &mut Graph<'_>,
    config: &ModelConfig,
    name: &str,
    queries: &Value,
    keys: &Value,
    visible: Option<&Value>,
) -> Result<Value, OnnxError> {
    let (heads, of_head) = (config.n_heads, config.attention_dim / config.n_heads);
    let by_head = g.ints(&[0, heads as i64, of_head as i64], &[3]);
    let mut projected = |part: &str, x: &Value, order: [i64; 3], is_value: bool| {
        let mut y = linear(g, &format!("{name}.{part}"), x)?;
        if is_value {
            y = g.op("Relu", &[&y], vec![]);
        }
        let y = g.op("Reshape", &[&y, &by_head], vec![]);
        Ok::<_, OnnxError>(g.op("Transpose", &[&y], vec![int_list("perm", &order)]))
    };
    let query = projected("query", queries, [1, 0, 2], false)?;
    let key = projected("key", keys, [1, 2, 0], false)?;
    let value = projected("value", keys, [1, 0, 2], true)?;
    let scale = g.float(1.0 / (of_head as f32).sqrt());
    let scores = g.op("MatMul", &[&query, &key], vec![]);
    let mut scores = g.op("Mul", &[&scores, &scale], vec![]);
    if let Some(visible) = visible {
        let unseen = g.float(UNSEEN);
        scores = g.op("Where", &[visible, &scores, &unseen], vec![]);
    }
    let mut shares = g.op("Softmax", &[&scores], vec![int("axis", -1)]);
    if let Some(visible) = visible {
        let flags = g.op("Cast", &[visible], vec![int("to", Float as i64)]);
        shares = g.op("Mul", &[&shares, &flags], vec![]);
    }
    let mixed = g.op("MatMul", &[&shares, &value], vec![]);
    let mixed = g.op("Transpose", &[&mixed], vec![int_list("perm", &[1, 0, 2])]);
    let side_by_side = g.ints(&[0, config.attention_dim as i64], &[2]);
    Ok(g.op("Reshape", &[&mixed, &side_by_side], vec![]))
}

/// PyTorch's `GRUCell`.
fn gru(g: &mut Graph<'_>, name: &str, h: usize, x: &Value, before: &Value) -> Result<Value, OnnxError> {
    let mut gates = |x: &Value, of: &str| {
        let weight = g.weight(&format!("{name}.weight_{of}"))?;
        let bias = g.weight(&format!("{name}.bias_{of}"))?;
        let together = g.op("Gemm", &[x, &weight, &bias], vec![int("transB", 1)]);
        Ok::<_, OnnxError>(g.split(&together, 3, h))
    };
    let (of_x, of_h) = (gates(x, "ih")?, gates(before, "hh")?);
    let mut gate = |at: usize| {
        let sum = g.op("Add", &[&of_x[at], &of_h[at]], vec![]);
        g.op("Sigmoid", &[&sum], vec![])
    };
    let (reset, update) = (gate(0), gate(1));
    let kept = g.op("Mul", &[&reset, &of_h[2]], vec![]);
    let new = g.op("Add", &[&of_x[2], &kept], vec![]);
    let new = g.op("Tanh", &[&new], vec![]);
    // (1 - update) new + update before
    let change = g.op("Sub", &[before, &new], vec![]);
    let change = g.op("Mul", &[&update, &change], vec![]);
    Ok(g.op("Add", &[&new, &change], vec![]))
}
