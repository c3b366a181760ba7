static const struct @functions@ FUNCTIONS = {
    .size = sizeof FUNCTIONS,
@entries@
};

static const struct ConefieldStage STAGES[] = {{
    .kind = @kind@,
    .name = TEXT("@name@"),
    .doc = TEXT(DOC),
    .schema = TEXT(SCHEMA),
    .create = create,
    .destroy = free,
    .describe = describe,
    .@table@ = &FUNCTIONS,
}};

static const struct ConefieldPlugin PLUGIN = {
    .size = sizeof PLUGIN,
    .abi_major = CONEFIELD_ABI_MAJOR,
    .abi_minor = CONEFIELD_ABI_MINOR,
    .name = TEXT("@name@"),
    .version = TEXT("0.1.0"),
    .licence = TEXT("Apache-2.0 OR MIT"),
    .stages = STAGES,
    .stage_count = sizeof STAGES / sizeof *STAGES,
    .stage_size = sizeof *STAGES,
};

const struct ConefieldPlugin *conefield_plugin(void) {
    return &PLUGIN;
}
